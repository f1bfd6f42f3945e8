"""Errors of the adapters. Every wait in this package ends in a result or in one of these.

::

    AdapterError
    ├── Unreachable         nobody listens there, or the connection was lost
    ├── TimedOut            no complete answer within the named bound (the connection is closed with it)
    ├── ProtocolError       the answer is not what the protocol allows (too large, garbage, wrong count)
    ├── Refused             the other side understood and said no (``ERROR: ...``, HTTP 4xx/5xx)
    ├── UnsafeText          a name or value that must not be sent (quote, line break, control character)
    ├── BadPicture          what came is not a picture, or not one of the promised size
    ├── ProfileError        a studio profile that cannot be used (``engine_adapters.profile``)
    └── ReplayMismatch      a replayed run went another way than the recorded one (``engine_adapters.transcript``)

Each message is one line: what, where (address), what to do.
"""

from __future__ import annotations


class AdapterError(Exception):
    """Base of every adapter error. ``where`` is the address or file it happened at."""

    def __init__(self, message: str, *, where: str = "") -> None:
        self.where = where
        super().__init__(f"{where}: {message}" if where else message)


class Unreachable(AdapterError):
    """Nobody listens at the address, or the connection was lost."""


class TimedOut(AdapterError):
    """No complete answer within the bound. ``bound_s`` is that bound, ``what`` was waited for."""

    def __init__(self, what: str, bound_s: float, *, where: str = "") -> None:
        self.what = what
        self.bound_s = bound_s
        super().__init__(f"no complete answer to {what} within {bound_s:g} s", where=where)


class ProtocolError(AdapterError):
    """The answer is not what the protocol allows."""


class Refused(AdapterError):
    """The other side understood and said no. ``answer`` is its text (shortened)."""

    def __init__(self, answer: str, *, where: str = "", command: str = "") -> None:
        self.answer = answer[:200]
        self.command = command[:200]
        told = f" to {self.command}" if self.command else ""
        super().__init__(f"refused{told}: {self.answer}", where=where)


class UnsafeText(AdapterError):
    """A name or value that must not be sent. Nothing was sent."""


class BadPicture(AdapterError):
    """What came is not a picture, or not one of the promised size."""
