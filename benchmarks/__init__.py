"""Accuracy and speed, side by side with the study's method and with public tools (``lensmatch bench``)."""
