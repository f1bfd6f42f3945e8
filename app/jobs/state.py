"""Which change of a job's state is allowed: a pure machine."""

from __future__ import annotations

from storage.records import JobState

ALLOWED: dict[JobState, frozenset[JobState]] = {
    JobState.QUEUED: frozenset({JobState.RUNNING, JobState.CANCELLED, JobState.FAILED}),
    JobState.RUNNING: frozenset({JobState.CANCELLING, JobState.DONE, JobState.FAILED}),
    JobState.CANCELLING: frozenset({JobState.CANCELLED, JobState.FAILED}),
    JobState.DONE: frozenset(),
    JobState.FAILED: frozenset(),
    JobState.CANCELLED: frozenset(),
}

TERMINAL = frozenset(state for state, following in ALLOWED.items() if not following)


def sources(state: JobState) -> frozenset[JobState]:
    """The states from which ``state`` may be reached."""
    return frozenset(before for before, following in ALLOWED.items() if state in following)
