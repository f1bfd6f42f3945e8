"""Errors of the app that several of its parts raise or show.

::

    ServiceError
    ├── QueueFull            as many jobs wait as the service takes; try again later
    ├── TooManyListeners     as many event sockets are open as the service takes
    └── (app.engines) EngineError

Each message is one line: what is wrong, where, what to do. Facts stand as attributes. Documents have theirs in
:mod:`app.documents`, the store in :mod:`storage.errors`.
"""

from __future__ import annotations


class ServiceError(Exception):
    """Base of every error that the service raises on purpose."""


class QueueFull(ServiceError):
    """No further job is taken for now. ``limit``: most waiting jobs; ``retry_after_s``: when to ask again."""

    def __init__(self, limit: int, retry_after_s: int = 30) -> None:
        self.limit = limit
        self.retry_after_s = retry_after_s
        super().__init__(f"{limit} jobs are waiting already, more are not taken; wait for one to end or cancel one")


class TooManyListeners(ServiceError):
    """No further listener is taken. ``limit``: most at once."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        super().__init__(f"{limit} event sockets are open already, more are not taken; close one or try again later")
