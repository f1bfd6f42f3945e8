"""The R3 engine's text socket: wire format, commands, conventions, client."""
