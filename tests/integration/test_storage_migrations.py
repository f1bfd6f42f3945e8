"""The schema: migrations make what the models say; an upgrade is whole or not at all, with a backup first."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import shutil
import sqlite3
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlmodel import Session, SQLModel

from calibration.tables import LevelResult, Provenance
from storage.database import MIGRATIONS, Database
from storage.errors import DatabaseUnusable, NotFound
from storage.exports.json_table import write_json
from storage.records import JobState
from storage.repository import Repository
from tests.support.service import lens_table

MOMENT = datetime(2026, 11, 21, 10, 0, 0, tzinfo=UTC)

NEXT = '''
"""A revision of tomorrow."""
import sqlalchemy as sa
from alembic import op

revision = "tomorrow"
down_revision = "{newest}"


def upgrade():
    op.create_table("heads", sa.Column("id", sa.Integer(), primary_key=True))
    op.add_column("jobs", sa.Column("priority", sa.Integer(), nullable=False, server_default="5"))
    op.execute("INSERT INTO heads (id) VALUES (1)")
    {end}
'''


def newest_revision() -> str:
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    return str(ScriptDirectory.from_config(config).get_current_head())


NEWEST = newest_revision()


def now() -> datetime:
    return MOMENT


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "lensmatch.db"


@pytest.fixture
async def job_id(path: Path) -> str:
    """A database of the newest schema that holds one job."""
    async with await Repository.open(path, now) as repository:
        return (await repository.create_job({"zooms": 7}, "XA 20x", "r3-a")).id


def newer_migrations(folder: Path, end: str = "") -> Path:
    copy = folder / "migrations"
    shutil.copytree(MIGRATIONS, copy, ignore=shutil.ignore_patterns("__pycache__"))
    step = NEXT.replace("{newest}", NEWEST).replace("{end}", end)
    (copy / "versions" / "tomorrow.py").write_text(step, encoding="utf-8")
    return copy


def rows(path: Path, query: str) -> list[tuple[object, ...]]:
    with contextlib.closing(sqlite3.connect(path)) as connection:
        return connection.execute(query).fetchall()


def backups(path: Path) -> list[str]:
    return sorted(entry.name for entry in path.parent.iterdir() if "backup" in entry.name)


async def test_the_migrations_make_what_the_models_say(path: Path) -> None:
    database = await Database.open(path, now)

    def differences(session: Session) -> list[object]:
        return list(compare_metadata(MigrationContext.configure(session.connection()), SQLModel.metadata))

    try:
        assert await database.read(differences) == []
    finally:
        await database.close()


async def test_a_fresh_or_current_database_needs_no_backup(path: Path, job_id: str) -> None:
    async with await Repository.open(path, now) as repository:
        assert (await repository.get_job(job_id)).request == {"zooms": 7}
    assert backups(path) == []


async def test_two_processes_may_make_the_database_at_once(path: Path) -> None:
    opened = await asyncio.gather(*(Repository.open(path, now) for _ in range(4)))
    for repository in opened:
        await repository.close()
    assert rows(path, "SELECT version_num FROM alembic_version") == [(NEWEST,)]


async def test_an_upgrade_keeps_the_rows_and_a_backup_of_before(path: Path, job_id: str, tmp_path: Path) -> None:
    database = await Database.open(path, now, newer_migrations(tmp_path))
    await database.close()
    assert rows(path, "SELECT version_num FROM alembic_version") == [("tomorrow",)]
    assert rows(path, "SELECT id, priority FROM jobs") == [(job_id, 5)]
    assert backups(path) == [f"lensmatch.backup-{NEWEST}-20261121T100000Z.db"]
    async with await Repository.open(path.with_name(backups(path)[0]), now) as repository:
        assert (await repository.get_job(job_id)).lens == "XA 20x"


async def test_a_failed_upgrade_leaves_the_old_database(path: Path, job_id: str, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="in the middle"):
        await Database.open(path, now, newer_migrations(tmp_path, "raise RuntimeError('in the middle')"))
    assert rows(path, "SELECT name FROM sqlite_master WHERE name = 'heads'") == []
    async with await Repository.open(path, now) as repository:
        assert (await repository.get_job(job_id)).lens == "XA 20x"


async def test_a_killed_upgrade_leaves_the_old_database(
    path: Path, job_id: str, tmp_path: Path, repository: Path
) -> None:
    migrations = newer_migrations(tmp_path, "import os; os._exit(9)")
    script = (
        "import asyncio, sys; from datetime import UTC, datetime; from pathlib import Path; "
        "from storage.database import Database; "
        "asyncio.run(Database.open(sys.argv[1], lambda: datetime.now(UTC), Path(sys.argv[2])))"
    )
    command = [sys.executable, "-c", script, str(path), str(migrations)]
    killed = await asyncio.to_thread(subprocess.run, command, cwd=repository, check=False, timeout=60)
    assert killed.returncode == 9
    assert len(backups(path)) == 1
    assert rows(path, "SELECT name FROM sqlite_master WHERE name = 'heads'") == []
    async with await Repository.open(path, now) as ledger:
        await ledger.check()
        assert (await ledger.get_job(job_id)).lens == "XA 20x"


async def test_no_backup_no_upgrade(path: Path, job_id: str, tmp_path: Path) -> None:
    (tmp_path / f"lensmatch.backup-{NEWEST}-20261121T100000Z.db.unfinished").mkdir()
    migrations = newer_migrations(tmp_path)
    with pytest.raises(DatabaseUnusable, match="cannot be opened for writing"):
        await Database.open(path, now, migrations)
    assert rows(path, "SELECT version_num FROM alembic_version") == [(NEWEST,)]
    assert rows(path, "SELECT id FROM jobs") == [(job_id,)]


async def test_a_database_of_a_newer_version_is_left_alone(path: Path, job_id: str, tmp_path: Path) -> None:
    database = await Database.open(path, now, newer_migrations(tmp_path))
    await database.close()
    with pytest.raises(DatabaseUnusable, match=r"newer version of Lensmatch \(schema tomorrow, .*; update Lensmatch"):
        await Repository.open(path, now)
    assert rows(path, "SELECT id, priority FROM jobs") == [(job_id, 5)]


def schema_of(folder: Path, newest: str) -> Path:
    """The migrations up to revision ``newest``, those of after left out."""
    copy = folder / newest
    shutil.copytree(MIGRATIONS, copy, ignore=shutil.ignore_patterns("__pycache__"))
    for step in (copy / "versions").glob("r*.py"):
        if step.name > f"r{newest}~":
            step.unlink()
    return copy


async def test_a_database_of_the_first_release_gets_a_place_for_evidence(path: Path, tmp_path: Path) -> None:
    before = await Database.open(path, now, schema_of(tmp_path, "0001"))
    await before.close()
    assert rows(path, "SELECT version_num FROM alembic_version") == [("0001",)]
    result = LevelResult.failed(0.0, 0.5, "dark")
    async with await Repository.open(path, now) as repository:
        job = await repository.create_job({"zooms": 7}, "XA 20x", "r3-a")
        await repository.set_job_state(job.id, JobState.RUNNING, expected=[JobState.QUEUED])
        await repository.save_level(job.id, 0, result, ("level_failed", {}), evidence='{"level_evidence":1}')
        await repository.save_level(job.id, 1, replace(result, zoom=1.0), ("level_failed", {}))
        found = await repository.get_evidence(job.id, 0.0, 0.5)
        assert found.document == b'{"level_evidence":1}'
        assert found.sha256 == hashlib.sha256(found.document).hexdigest()
        with pytest.raises(NotFound, match="evidence of level zoom 1"):
            await repository.get_evidence(job.id, 1.0, 0.5)
    assert backups(path) == ["lensmatch.backup-0001-20261121T100000Z.db"]


@pytest.mark.parametrize(
    ("before_it", "file", "table"),
    [("0001", "r0002_evidence.py", "evidence"), ("0002", "r0003_table_actions.py", "table_actions")],
)
async def test_killed_half_way_the_release_before_is_still_there_and_is_then_upgraded(
    path: Path, tmp_path: Path, repository: Path, before_it: str, file: str, table: str
) -> None:
    before = await Database.open(path, now, schema_of(tmp_path, before_it))
    await before.close()
    deadly = tmp_path / "deadly"
    shutil.copytree(MIGRATIONS, deadly, ignore=shutil.ignore_patterns("__pycache__"))
    step = deadly / "versions" / file
    step.write_text(step.read_text("utf-8") + "    __import__('os')._exit(9)\n", "utf-8")
    script = (
        "import asyncio, sys; from datetime import UTC, datetime; from pathlib import Path; "
        "from storage.database import Database; "
        "asyncio.run(Database.open(sys.argv[1], lambda: datetime.now(UTC), Path(sys.argv[2])))"
    )
    command = [sys.executable, "-c", script, str(path), str(deadly)]
    killed = await asyncio.to_thread(subprocess.run, command, cwd=repository, check=False, timeout=60)
    assert killed.returncode == 9
    assert rows(path, "SELECT version_num FROM alembic_version") == [(before_it,)]
    assert rows(path, f"SELECT name FROM sqlite_master WHERE name = '{table}'") == []
    async with await Repository.open(path, now) as ledger:
        await ledger.check()
    assert rows(path, "SELECT version_num FROM alembic_version") == [(NEWEST,)]


async def test_tables_of_before_the_ledger_of_actions_are_kept_and_can_be_approved(path: Path, tmp_path: Path) -> None:
    before = await Database.open(path, now, schema_of(tmp_path, "0002"))
    await before.close()
    told = replace(lens_table(), provenance=Provenance("calibrated", "lensmatch 0.1.0", note="é"))
    documents = [write_json(told), write_json(replace(lens_table(), version=2))]
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("INSERT INTO lenses (id, name, camera) VALUES (1, 'XA 20x', 'Cam0')")
        for version, document in enumerate(documents, start=1):
            connection.execute(
                "INSERT INTO tables (lens_id, version, created, document, sha256) VALUES (1, ?, ?, ?, ?)",
                (version, "2026-11-21T10:00:00.000000Z", document.decode(), hashlib.sha256(document).hexdigest()),
            )
    async with await Repository.open(path, now) as repository:
        second, first = await repository.list_tables(1)
        assert (first.provenance, second.provenance) == (told.provenance, None)
        assert (await repository.get_table(first.id)).table == told
        assert [first.approved, second.approved, *await repository.table_history(1)] == [False, False]
        assert (await repository.approve_table(first.id)).approved
        assert [table.approved for table in await repository.list_tables(1)] == [False, True]
        assert (await repository.save_table(None, lens_table())).version == 3
    assert rows(path, "SELECT sha256 FROM tables WHERE id < 3") == [
        (hashlib.sha256(document).hexdigest(),) for document in documents
    ]
    assert backups(path) == ["lensmatch.backup-0002-20261121T100000Z.db"]


async def test_a_damaged_table_of_before_does_not_keep_the_database_from_opening(path: Path, tmp_path: Path) -> None:
    before = await Database.open(path, now, schema_of(tmp_path, "0002"))
    await before.close()
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("INSERT INTO lenses (id, name, camera) VALUES (1, 'XA 20x', 'Cam0')")
        connection.execute(
            "INSERT INTO tables (lens_id, version, created, document, sha256) VALUES (1, 1, '', '{', '')"
        )
    async with await Repository.open(path, now) as repository:
        assert [lens.name for lens in await repository.list_lenses()] == ["XA 20x"]
    assert rows(path, "SELECT document, provenance FROM tables") == [("{", None)]
