"""Versions of lens tables in the store: approval, roll back, import, and the ledger that nothing can rewrite."""

from __future__ import annotations

import asyncio
import contextlib
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.tables import Provenance
from storage.errors import NameClash, NotApproved, NotFound, NothingBefore
from storage.records import TableAction
from storage.repository import Repository
from storage.table_store import standing_approvals
from tests.support.clock import Clock
from tests.support.service import lens_table, stored_job

IMPORTED = Provenance("imported", "lensmatch 1", inputs_sha256="ab" * 32)


async def versions(ledger: Repository, count: int) -> list[int]:
    """Ids of that many tables of one lens."""
    return [(await ledger.save_table(None, lens_table())).id for _ in range(count)]


async def approved(ledger: Repository) -> list[int]:
    """The approved tables of the first lens, as its list of tables says."""
    return [table.id for table in await ledger.list_tables(1) if table.approved]


async def actions(ledger: Repository, table_id: int) -> list[tuple[str, int, int | None]]:
    """A table's history, oldest first: kind, table, the one replaced."""
    return [(one.kind.value, one.table_id, one.replaces_id) for one in (await ledger.table_history(table_id))[::-1]]


async def test_approving_moves_the_one_approval_of_a_lens(ledger: Repository) -> None:
    first, second = await versions(ledger, 2)
    assert await approved(ledger) == []
    assert await ledger.approved_table(1) is None
    assert (await ledger.approve_table(first, by="Anna", note="checked on stage 2")).approved
    assert (await ledger.approve_table(second)).approved
    assert await approved(ledger) == [second]
    assert not (await ledger.get_table(first)).summary.approved
    record = await ledger.approved_table(1)
    assert record == await ledger.get_table(second)
    assert [lens.approved_table_id for lens in await ledger.list_lenses()] == [second]
    assert await actions(ledger, first) == [
        ("imported", first, None),
        ("approved", first, None),
        ("approved", second, first),
    ]
    told = (await ledger.table_history(first))[1]
    assert (told.by, told.note, told.version, told.lens_id) == ("Anna", "checked on stage 2", 1, 1)


async def test_approving_twice_is_as_good_as_once(ledger: Repository) -> None:
    (table_id,) = await versions(ledger, 1)
    once = await ledger.approve_table(table_id)
    assert await ledger.approve_table(table_id, by="somebody else") == once
    assert await actions(ledger, table_id) == [("imported", table_id, None), ("approved", table_id, None)]


async def test_lenses_have_approvals_of_their_own(ledger: Repository) -> None:
    one, other = await ledger.save_table(None, lens_table("A")), await ledger.save_table(None, lens_table("B"))
    await ledger.approve_table(one.id)
    await ledger.approve_table(other.id)
    assert [lens.approved_table_id for lens in await ledger.list_lenses()] == [one.id, other.id]
    assert (await ledger.get_table(one.id)).summary.approved


async def test_rolling_back_goes_to_the_table_approved_before_and_on_from_there(ledger: Repository) -> None:
    a, b, c = await versions(ledger, 3)
    for table_id in (a, b, c):
        await ledger.approve_table(table_id)
    assert (await ledger.roll_back_table(c)).id == b
    assert (await ledger.roll_back_table(b)).id == a
    with pytest.raises(NothingBefore, match="no other table was approved before table 1"):
        await ledger.roll_back_table(a)
    assert await approved(ledger) == [a]
    await ledger.approve_table(c)
    assert (await ledger.roll_back_table(c, by="Ben", note="wrong mount")).id == a
    back = (await ledger.table_history(c))[0]
    assert (back.kind, back.table_id, back.replaces_id, back.by) == (TableAction.ROLLED_BACK, a, c, "Ben")
    assert len(await ledger.list_tables(1)) == 3


async def test_only_the_approved_table_is_rolled_back_and_only_once(ledger: Repository) -> None:
    a, b = await versions(ledger, 2)
    with pytest.raises(NotApproved, match="table 1 is not approved, no table of its lens is"):
        await ledger.roll_back_table(a)
    await ledger.approve_table(a)
    await ledger.approve_table(b)
    rolled = await asyncio.gather(*(ledger.roll_back_table(b) for _ in range(5)), return_exceptions=True)
    assert sum(isinstance(result, NotApproved) for result in rolled) == 4
    assert await approved(ledger) == [a]


async def test_two_processes_never_approve_two_tables(ledger: Repository, tmp_path: Path) -> None:
    ids = await versions(ledger, 4)
    async with await Repository.open(tmp_path / "lensmatch.db", Clock()) as other:
        calls = ((ledger if number % 2 else other).approve_table(ids[number % 4]) for number in range(40))
        await asyncio.gather(*calls)
    assert len(await approved(ledger)) == 1
    taken = [one for table_id in ids for one in await ledger.table_history(table_id) if one.table_id == table_id]
    chain = sorted((one.number, one.table_id, one.replaces_id) for one in taken if one.kind is TableAction.APPROVED)
    assert [replaced for _, _, replaced in chain] == [None, *(table_id for _, table_id, _ in chain[:-1])]


@given(st.lists(st.sampled_from([1, 2, 3, "back"])))
def test_a_roll_back_undoes_one_approval(steps: list[int | str]) -> None:
    told: list[tuple[str, int]] = []
    model: list[int] = []
    for step in steps:
        if isinstance(step, int):
            if not model or model[-1] != step:
                model.append(step)
                told.append((TableAction.APPROVED, step))
        elif len(model) > 1:
            model.pop()
            told.append((TableAction.ROLLED_BACK, model[-1]))
        told.append((TableAction.PUBLISHED, 9))
    assert standing_approvals(told) == model
    assert not model or [table for kind, table in told if kind != TableAction.PUBLISHED][-1] == model[-1]


async def test_how_a_table_came_is_its_first_action(ledger: Repository) -> None:
    await stored_job(ledger)
    corrected = replace(lens_table(), provenance=Provenance("corrected", "lensmatch 1"))
    await ledger.save_table(None, corrected, by="Anna", note="moved by 1 px")
    told = (await ledger.table_history(2))[0]
    assert (told.by, told.note) == ("Anna", "moved by 1 px")
    await ledger.note_published(2, by="Anna", note="engine default, 0.02 px")
    assert await actions(ledger, 1) == [("calibrated", 1, None)]
    assert await actions(ledger, 2) == [("corrected", 2, None), ("published", 2, None)]
    assert await approved(ledger) == []
    assert (await ledger.table_history(2, limit=1))[0].kind is TableAction.PUBLISHED


async def test_provenance_stands_in_the_list(ledger: Repository) -> None:
    told = replace(IMPORTED, note="ü", profile="studio")
    await ledger.save_table(None, replace(lens_table(), provenance=told))
    await ledger.save_table(None, lens_table())
    assert [table.provenance for table in await ledger.list_tables(1)] == [None, told]
    assert (await ledger.get_table(1)).table.provenance == told


async def test_a_table_and_how_it_came_are_stored_together_or_not_at_all(
    ledger: Repository, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("in the middle")

    with monkeypatch.context() as patched:
        patched.setattr("storage.table_store._add_action", fail)
        with pytest.raises(RuntimeError, match="in the middle"):
            await ledger.import_table(lens_table())
    assert await ledger.list_lenses() == []
    assert (await ledger.import_table(lens_table()))[0].version == 1


# Imports


async def test_the_same_file_again_gives_the_version_of_before(ledger: Repository) -> None:
    table = replace(lens_table(), provenance=IMPORTED)
    first, new = await ledger.import_table(table, by="Anna")
    again, newer = await ledger.import_table(replace(table, version=7))
    assert (new, newer, again) == (True, False, first)
    changed, new = await ledger.import_table(replace(table, provenance=replace(IMPORTED, inputs_sha256="cd" * 32)))
    assert (new, changed.version) == (True, 2)
    unknown = [await ledger.import_table(lens_table()) for _ in range(2)]
    assert [(summary.version, new) for summary, new in unknown] == [(3, True), (4, True)]


async def test_a_table_of_another_picture_is_refused_unless_asked_for(ledger: Repository) -> None:
    mine = replace(lens_table(), sensor_mm=(9.59, 5.39))
    await ledger.import_table(mine)
    for change, told in (
        ({"sensor_mm": (24.9, 14.0)}, "a sensor of 9.59 x 5.39 mm there, of 24.9 x 14 mm here"),
        ({"image_size": (1280, 720), "levels": lens_table().levels[1:]}, "pictures of 1920 x 1080 px there"),
        ({"pixel_aspect": 1.1, "levels": lens_table().levels[1:]}, "pixel aspect 1 there, 1.1 here"),
    ):
        with pytest.raises(NameClash, match=f"XA 20x on Cam0 has tables of another picture: {told}"):
            await ledger.import_table(replace(mine, **change))
    assert len(await ledger.list_tables(1)) == 1
    summary, new = await ledger.import_table(replace(mine, sensor_mm=(24.9, 14.0)), other_picture_too=True)
    assert (summary.version, new) == (2, True)
    assert (await ledger.import_table(replace(mine, sensor_mm=None)))[1]
    # What is approved counts, not what came last.
    await ledger.approve_table(1)
    assert (await ledger.import_table(mine))[1]
    with pytest.raises(NameClash):
        await ledger.import_table(replace(mine, sensor_mm=(24.9, 14.0)))
    assert (await ledger.import_table(replace(mine, camera="Cam1", sensor_mm=(24.9, 14.0))))[0].version == 1


# Nothing is rewritten


@pytest.mark.parametrize(
    ("statement", "told"),
    [
        ("UPDATE table_actions SET table_id = 2", "append-only"),
        ("DELETE FROM table_actions", "append-only"),
        ("UPDATE tables SET document = '{}'", "never change"),
        ("DELETE FROM tables WHERE id = 2", "never change"),
    ],
)
async def test_the_database_itself_refuses_a_change(
    ledger: Repository, tmp_path: Path, statement: str, told: str
) -> None:
    await ledger.approve_table((await versions(ledger, 2))[0])
    with (
        contextlib.closing(sqlite3.connect(tmp_path / "lensmatch.db")) as connection,
        pytest.raises(sqlite3.IntegrityError, match=told),
    ):
        connection.execute(statement)


async def test_what_is_not_there_is_said_so(ledger: Repository) -> None:
    calls = [
        ledger.approve_table(9),
        ledger.roll_back_table(9),
        ledger.note_published(9),
        ledger.table_history(9),
        ledger.approved_table(9),
    ]
    for call in calls:
        with pytest.raises(NotFound, match="there is no lens"):
            await call


APPROVER = """
import asyncio, sys
from datetime import UTC, datetime
from storage.repository import Repository

async def main(path, ids):
    ledger = await Repository.open(path, lambda: datetime.now(UTC))
    while True:
        for table_id in ids:
            await ledger.approve_table(table_id)
            print(table_id, flush=True)

asyncio.run(main(sys.argv[1], [int(word) for word in sys.argv[2:]]))
"""


async def test_kill_9_loses_no_acknowledged_approval(ledger: Repository, tmp_path: Path, repository: Path) -> None:
    ids = await versions(ledger, 3)
    path = tmp_path / "lensmatch.db"

    def approve_until_killed() -> list[int]:
        command = [sys.executable, "-c", APPROVER, str(path), *map(str, ids)]
        said = []
        with subprocess.Popen(command, cwd=repository, stdout=subprocess.PIPE, text=True) as worker:
            assert worker.stdout is not None
            for line in worker.stdout:
                said.append(int(line))
                if len(said) == 20:
                    worker.kill()
        return said

    said = await asyncio.to_thread(approve_until_killed)
    await ledger.check()
    taken = {one.number: one for table_id in ids for one in await ledger.table_history(table_id)}
    stored = [taken[number].table_id for number in sorted(taken) if taken[number].kind is TableAction.APPROVED]
    assert stored[: len(said)] == said
    assert await approved(ledger) == [stored[-1]]
