"""Solving a level: from detections to a lens with its uncertainty, with or without an engine in the loop."""
