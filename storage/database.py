"""The database file: opening, migrating, and one thread that does all work on it.

SQLite in WAL mode with ``synchronous=FULL``: what a commit has acknowledged survives a killed process and a power
cut. All SQL of one process runs in one named thread, so the event loop never waits for the disk; a cancelled call may
still be committed, wholly or not at all. Write transactions take the write lock at their start (BEGIN IMMEDIATE), so
that what they have read stays true until they commit.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import sqlite3
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, Engine, create_engine, event, inspect, text
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError
from sqlmodel import Session

from storage.errors import DatabaseUnusable, StorageBusy, StorageError, StorageFull

BUSY_TIMEOUT_S = 5.0
"""How long a statement waits for another process's write: a thousand times one commit (3 ms), and short enough for a
person to wait."""

MIGRATIONS = Path(__file__).parent / "migrations"

_READ_ONLY = "lensmatch_read_only"
_T = TypeVar("_T")


class Database:
    """An open database. One object is one file; closed once, it is not opened again."""

    def __init__(self, engine: Engine, executor: ThreadPoolExecutor, where: str) -> None:
        self._engine = engine
        self._reader = engine.execution_options(**{_READ_ONLY: True})
        self._executor = executor
        self._closed = False
        self.where = where

    @classmethod
    async def open(
        cls, url_or_path: str | os.PathLike[str], now: Callable[[], datetime], migrations: Path = MIGRATIONS
    ) -> Database:
        """Open or make the database, and bring its schema up to date, a backup copy first.

        ``url_or_path``: a file, or ``sqlite:///file``. Missing folders are made. Raises :class:`DatabaseUnusable`,
        :class:`StorageBusy`, :class:`StorageFull`; the file is then as it was.
        """
        path = database_path(url_or_path)
        executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="lensmatch-storage")
        try:
            engine = await asyncio.get_running_loop().run_in_executor(executor, _open_file, path, now, migrations)
        except BaseException:
            executor.shutdown(wait=False)
            raise
        return cls(engine, executor, str(path))

    async def read(self, work: Callable[[Session], _T]) -> _T:
        """Run ``work`` in the storage thread on one snapshot of the database."""
        return await self._run(lambda: self._transact(self._reader, work))

    async def write(self, work: Callable[[Session], _T]) -> _T:
        """Run ``work`` in the storage thread as one write transaction: committed when it returns, undone if it raises.

        A cancellation does not undo a transaction that has begun. Raises :class:`StorageBusy`, :class:`StorageFull`.
        """
        return await self._run(lambda: self._transact(self._engine, work))

    async def check(self) -> None:
        """Read the whole file and check it. Raises :class:`DatabaseUnusable` when it is damaged."""

        def look(session: Session) -> str:
            return str(session.connection().exec_driver_sql("PRAGMA integrity_check(1)").scalar())

        found = await self.read(look)
        if found != "ok":
            raise _damaged(self.where, found)

    async def close(self) -> None:
        """Finish the work under way, release the file and end the thread. Safe to call twice."""
        if self._closed:
            return
        self._closed = True
        await asyncio.get_running_loop().run_in_executor(self._executor, self._engine.dispose)
        self._executor.shutdown(wait=True)

    async def _run(self, work: Callable[[], _T]) -> _T:
        if self._closed:
            raise StorageError(f"{self.where}: the store was closed; open it again")
        return await asyncio.get_running_loop().run_in_executor(self._executor, work)

    def _transact(self, engine: Engine, work: Callable[[Session], _T]) -> _T:
        with translated(self.where), Session(engine) as session, session.begin():
            return work(session)


def database_path(url_or_path: str | os.PathLike[str]) -> Path:
    """The file that a path or ``sqlite:///`` URL names. Raises :class:`DatabaseUnusable` for other databases."""
    given = os.fspath(url_or_path)
    if "://" not in given:
        return Path(given).absolute()
    try:
        url = make_url(given)
    except ArgumentError as error:
        raise DatabaseUnusable("database", "its address cannot be read", "write sqlite:///path/to/file.db") from error
    if url.get_backend_name() != "sqlite" or not url.database or url.database == ":memory:":
        shown = url.render_as_string(hide_password=True)
        raise DatabaseUnusable(shown, "only SQLite files are supported so far", "write sqlite:///path/to/file.db")
    return Path(url.database).absolute()


@contextlib.contextmanager
def translated(where: str) -> Iterator[None]:
    """Turn the driver's errors into those of :mod:`storage.errors`."""
    try:
        yield
    except DBAPIError as error:
        raise _storage_error(where, error.orig) from error
    except (sqlite3.Error, OSError) as error:
        raise _storage_error(where, error) from error


def _storage_error(where: str, error: BaseException | None) -> StorageError:
    if isinstance(error, OSError):
        if error.errno == errno.ENOSPC:
            return StorageFull(where)
        return _not_writable(where, error.strerror or str(error))
    # The low byte is SQLite's primary result code, the rest says more about it.
    code = (getattr(error, "sqlite_errorcode", None) or 0) & 0xFF
    if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        return StorageBusy(where, BUSY_TIMEOUT_S)
    if code == sqlite3.SQLITE_FULL:
        return StorageFull(where)
    if code == sqlite3.SQLITE_NOTADB:
        return DatabaseUnusable(where, "is not an SQLite database", "name another file")
    if code == sqlite3.SQLITE_CORRUPT:
        return _damaged(where, str(error))
    if code in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM, sqlite3.SQLITE_IOERR):
        return _not_writable(where, str(error))
    return StorageError(f"{where}: {error}")


def _damaged(where: str, found: str) -> DatabaseUnusable:
    return DatabaseUnusable(where, f"is damaged ({found})", "put back a backup copy, or name another file")


def _not_writable(where: str, found: str) -> DatabaseUnusable:
    todo = "check that the folder exists and may be written, or name another file"
    return DatabaseUnusable(where, f"cannot be opened for writing ({found})", todo)


def _open_file(path: Path, now: Callable[[], datetime], migrations: Path) -> Engine:
    where = str(path)
    if path.is_dir():
        raise DatabaseUnusable(where, "is a folder", "name a file in it")
    with translated(where):
        path.parent.mkdir(parents=True, exist_ok=True)
        engine = create_engine(
            URL.create("sqlite", database=where),
            pool_size=1,
            max_overflow=0,
            connect_args={"check_same_thread": False, "timeout": BUSY_TIMEOUT_S},
        )
        event.listen(engine, "connect", _on_connect)
        event.listen(engine, "begin", _on_begin)
        try:
            _refuse_foreign(engine, where)
            _use_wal(engine, where)
            _upgrade(engine, path, now, migrations)
        except BaseException:
            engine.dispose()
            raise
    return engine


def _on_connect(connection: sqlite3.Connection, _record: object) -> None:
    connection.isolation_level = None  # transactions begin where _on_begin says, not where the driver guesses
    for pragma in (
        "synchronous = FULL",
        "fullfsync = ON",  # only macOS knows the difference: its fsync leaves data in the drive's cache
        "foreign_keys = ON",
    ):
        connection.execute(f"PRAGMA {pragma}")


def _on_begin(connection: Connection) -> None:
    read_only = connection.get_execution_options().get(_READ_ONLY, False)
    connection.exec_driver_sql("BEGIN" if read_only else "BEGIN IMMEDIATE")


def _refuse_foreign(engine: Engine, where: str) -> None:
    """Leave alone what another program made: nothing may be written before this has passed."""
    with engine.execution_options(**{_READ_ONLY: True}).connect() as connection:
        names = set(inspect(connection).get_table_names())
    if names and not {"alembic_version", "jobs"} <= names:
        raise DatabaseUnusable(where, "is a database of another program", "name another file")


def _use_wal(engine: Engine, where: str) -> None:
    raw = engine.raw_connection()
    try:
        mode = raw.cursor().execute("PRAGMA journal_mode = WAL").fetchone()[0]
    finally:
        raw.close()
    if mode != "wal":
        raise _not_writable(where, f"its disk does not allow write-ahead logging, journal mode {mode}")


def _upgrade(engine: Engine, path: Path, now: Callable[[], datetime], migrations: Path) -> None:
    """Bring the schema to the newest revision in one transaction, after a backup of what there was."""
    config = Config()
    config.set_main_option("script_location", str(migrations).replace("%", "%%"))
    scripts = ScriptDirectory.from_config(config)
    newest = scripts.get_current_head()
    with engine.begin() as connection:
        found = MigrationContext.configure(connection).get_current_revision()
        if found == newest:
            return
        known = {script.revision for script in scripts.walk_revisions()}
        if found is not None and found not in known:
            raise DatabaseUnusable(
                str(path),
                f"was written by a newer version of Lensmatch (schema {found}, this one knows {newest})",
                "update Lensmatch, or name another file",
            )
        if found is not None:
            _back_up(path, found, now())
        config.attributes["connection"] = connection
        command.upgrade(config, "head")
        broken = connection.execute(text("PRAGMA foreign_key_check")).first()
        if broken is not None:
            raise _damaged(str(path), f"a row of {broken[0]} refers to nothing after the upgrade")


def _back_up(path: Path, revision: str, at: datetime) -> Path:
    """Copy the database beside itself, whole or not at all."""
    stamp = at.astimezone(UTC).strftime("%Y%m%dT%H%M%SZ")
    backup = path.with_name(f"{path.stem}.backup-{revision}-{stamp}{path.suffix}")
    unfinished = backup.with_name(f"{backup.name}.unfinished")
    try:
        with (
            contextlib.closing(sqlite3.connect(path, timeout=BUSY_TIMEOUT_S)) as source,
            contextlib.closing(sqlite3.connect(unfinished)) as target,
        ):
            source.backup(target)
        os.replace(unfinished, backup)
    except BaseException:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)
        raise
    return backup
