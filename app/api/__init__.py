"""The service's routes by resource, its event sockets, and one table of errors."""
