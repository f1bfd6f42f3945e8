"""Errors of the store and of the formats.

::

    StorageError
    ├── NotFound              no job, level, table, lens or picture of that id
    ├── IdempotencyConflict   the same idempotency key came with another request
    ├── StaleState            the job is no longer in the state that the caller took it to be in
    ├── EngineBusy            another job is already running on that engine
    ├── AlreadyStored         this level (job, zoom, focus, attempt) was committed before
    ├── NameClash             the lens and camera have tables of another picture or sensor
    ├── NotApproved           a table that is not (or no longer) the approved one of its lens cannot be rolled back
    ├── NothingBefore         no other table was approved before this one
    ├── TooLarge              a picture or document larger than the store takes
    ├── BadDocument           a lens table that cannot be read: damaged, foreign, or contradicting itself
    ├── CannotExport          a lens table that a format cannot carry at all
    ├── StorageBusy           another process held the database longer than the named bound; may be tried again
    ├── StorageFull           no space left; nothing of the refused write was kept; may be tried again
    └── DatabaseUnusable      damaged, not a database, of a newer version, of another program, not writable

Each message is one line: what is wrong, where, what to do. Facts stand as attributes.
"""

from __future__ import annotations


class StorageError(Exception):
    """Base of every error that the store raises on purpose."""


class NotFound(StorageError):
    """Nothing is stored under that id. ``what`` (``job``, ``table`` ...), ``key``."""

    def __init__(self, what: str, key: object) -> None:
        self.what = what
        self.key = str(key)[:200]
        super().__init__(f"there is no {what} {self.key}")


class IdempotencyConflict(StorageError):
    """The key was used before with another request. ``key``, ``job_id`` of the first use."""

    def __init__(self, key: str, job_id: str) -> None:
        self.key = key
        self.job_id = job_id
        super().__init__(
            f"idempotency key {key!r} was used for job {job_id} with another request; send a new key for a new request"
        )


class StaleState(StorageError):
    """A compare-and-set found the job in another state. ``job_id``, ``expected`` states, ``actual`` state."""

    def __init__(self, job_id: str, expected: tuple[str, ...], actual: str) -> None:
        self.job_id = job_id
        self.expected = expected
        self.actual = actual
        super().__init__(f"job {job_id} is {actual}, not {' or '.join(expected)}; read its state again")


class EngineBusy(StorageError):
    """The engine already has a running job. ``engine``."""

    def __init__(self, engine: str) -> None:
        self.engine = engine
        super().__init__(f"engine {engine!r} already runs another job; wait for it or cancel it")


class AlreadyStored(StorageError):
    """The level was committed before, and such a one never changes. ``job_id``, ``zoom``, ``focus``, ``attempt``."""

    def __init__(self, job_id: str, zoom: float, focus: float, attempt: int) -> None:
        self.job_id = job_id
        self.zoom = zoom
        self.focus = focus
        self.attempt = attempt
        super().__init__(
            f"job {job_id} already has zoom {zoom:g}, focus {focus:g}, attempt {attempt}; "
            "measure it again as the next attempt"
        )


class NameClash(StorageError):
    """A table that does not fit those of its lens and camera. ``lens``, ``camera``, ``difference`` in words."""

    def __init__(self, lens: str, camera: str, difference: str) -> None:
        self.lens = lens
        self.camera = camera
        self.difference = difference
        super().__init__(
            f"{lens} on {camera} has tables of another picture: {difference}; "
            "store this one under another camera's name, or ask for it all the same"
        )


class NotApproved(StorageError):
    """The table is not the approved one of its lens. ``table_id``, ``approved_id`` of that one, None: there is none."""

    def __init__(self, table_id: int, approved_id: int | None) -> None:
        self.table_id = table_id
        self.approved_id = approved_id
        instead = "no table of its lens is" if approved_id is None else f"table {approved_id} is"
        super().__init__(f"table {table_id} is not approved, {instead}; only the approved table can be rolled back")


class NothingBefore(StorageError):
    """No other table was approved before this one. ``table_id``."""

    def __init__(self, table_id: int) -> None:
        self.table_id = table_id
        super().__init__(f"no other table was approved before table {table_id}; approve the one that is to be used")


class TooLarge(StorageError):
    """More bytes than the store takes. ``what``, ``size`` and ``limit`` in bytes."""

    def __init__(self, what: str, size: int, limit: int) -> None:
        self.what = what
        self.size = size
        self.limit = limit
        super().__init__(f"{what} has {size} bytes, at most {limit} are taken")


class BadDocument(StorageError):
    """A lens table that cannot be read. ``field`` is where in the document ('' for the document as a whole)."""

    def __init__(self, field: str, why: str, todo: str) -> None:
        self.field = field
        place = f"lens table, {field}" if field else "lens table"
        super().__init__(f"{place}: {why}; {todo}")


class CannotExport(StorageError):
    """A lens table that a format cannot carry."""


class StorageBusy(StorageError):
    """Another process held the database longer than ``bound_s``. ``where`` is the database."""

    def __init__(self, where: str, bound_s: float) -> None:
        self.where = where
        self.bound_s = bound_s
        super().__init__(
            f"{where}: held by another process for more than {bound_s:g} s; try again, or end that process"
        )


class StorageFull(StorageError):
    """No space left for the database. ``where`` is the database."""

    def __init__(self, where: str) -> None:
        self.where = where
        super().__init__(f"{where}: no space left on its disk; free some space and try again, nothing was half written")


class DatabaseUnusable(StorageError):
    """The database cannot be used as it is. ``where`` is the database."""

    def __init__(self, where: str, why: str, todo: str) -> None:
        self.where = where
        super().__init__(f"{where}: {why}; {todo}")
