"""Time for what asks a clock."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta


class Clock:
    """A clock that is a second later at each look."""

    def __init__(self) -> None:
        self.moment = datetime(2026, 11, 21, 10, tzinfo=UTC)

    def __call__(self) -> datetime:
        self.moment += timedelta(seconds=1)
        return self.moment
