"""The MockBoard's web API: the engine's current output picture as base64 text."""
