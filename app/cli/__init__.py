"""The command line: one module a command, shared output in ``console``."""
