"""Lens tables in the store: numbered versions that never change, and the ledger of what was done with them.

Which table of a lens is approved follows from that ledger alone: it is the table of the lens's last approval or roll
back, so that there is at most one. Each method is one transaction; what each may raise besides the errors of the
database itself, it says (:class:`storage.repository.Repository`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from datetime import datetime

from sqlalchemy import func
from sqlmodel import Session, col, select

from calibration.tables import LensTable, other_picture
from storage import models
from storage.database import Database
from storage.errors import NameClash, NotApproved, NotFound, NothingBefore
from storage.exports.json_table import read_json, write_json
from storage.records import (
    ActionRecord,
    EventDraft,
    LensRecord,
    TableAction,
    TableRecord,
    TableSummary,
)
from storage.rows import (
    action_record,
    append_event,
    approved_table_id,
    find_job,
    lens_id_of,
    page_limit,
    require_lens,
    stored,
    table_record,
    table_rows,
    table_summary,
    to_json,
)


class TableStore:
    """The part of the store that keeps lens tables. ``now`` gives the current time, aware."""

    def __init__(self, database: Database, now: Callable[[], datetime]) -> None:
        self._database = database
        self._now = now

    async def save_table(
        self,
        job_id: str | None,
        table: LensTable,
        event: EventDraft | None = None,
        *,
        by: str | None = None,
        note: str | None = None,
    ) -> TableSummary:
        """Store a table as the next version of its lens and camera, whatever version it says itself, with its event.

        ``job_id`` None: a table of no job, imported or corrected as its provenance says (it then has no event).
        A job has one table: saving again, as after a restart, gives the stored one back and appends nothing. Raises
        :class:`NotFound`.
        """
        now = self._now()

        def work(session: Session) -> TableSummary:
            job = None if job_id is None else find_job(session, job_id)
            if job is not None:
                earlier = session.exec(table_rows().where(models.Table.job_id == job_id)).one_or_none()
                if earlier is not None:
                    return table_summary(earlier, approved_table_id(session, earlier.lens_id))
            summary = _add_table(session, table, job_id, now, by, note)
            if job is not None and event is not None:
                append_event(session, job, event, now)
            return summary

        return await self._database.write(work)

    async def import_table(
        self, table: LensTable, *, by: str | None = None, note: str | None = None, other_picture_too: bool = False
    ) -> tuple[TableSummary, bool]:
        """Store a table that was read from a file as the next version; whether it is new.

        A file that was imported before (the same provenance) gives the version that was stored then. Raises
        :class:`NameClash` when the lens's approved table, or its newest one where none is, is of another picture or
        sensor, unless ``other_picture_too``.
        """
        now = self._now()

        def work(session: Session) -> tuple[TableSummary, bool]:
            lens_id = _lens_id(session, table.lens, table.camera)
            if lens_id is not None:
                approved_id = approved_table_id(session, lens_id)
                told = _provenance_text(table)
                same = table_rows().where(models.Table.lens_id == lens_id, models.Table.provenance == told)
                earlier = None if told is None else session.exec(same.order_by(col(models.Table.id))).first()
                if earlier is not None:
                    return table_summary(earlier, approved_id), False
                if not other_picture_too:
                    _refuse_other_picture(session, table, lens_id, approved_id)
            return _add_table(session, table, None, now, by, note), True

        return await self._database.write(work)

    async def get_table(self, table_id: int) -> TableRecord:
        """A stored table. Raises :class:`NotFound`."""

        def work(session: Session) -> TableRecord:
            row = _find_table(session, table_id)
            return table_record(row, approved_table_id(session, row.lens_id))

        return await self._database.read(work)

    async def table_of_job(self, job_id: str) -> TableSummary | None:
        """The table that a job made, None while it has none. Raises :class:`NotFound` for the job."""

        def work(session: Session) -> TableSummary | None:
            find_job(session, job_id)
            row = session.exec(table_rows().where(models.Table.job_id == job_id)).one_or_none()
            return None if row is None else table_summary(row, approved_table_id(session, row.lens_id))

        return await self._database.read(work)

    async def list_lenses(self) -> list[LensRecord]:
        """Every lens and camera that has a table, by name."""

        def work(session: Session) -> list[LensRecord]:
            newest = func.max(models.Table.version)
            query = (
                select(models.Lens, newest)
                .join(models.Table, col(models.Table.lens_id) == col(models.Lens.id))
                .group_by(col(models.Lens.id))
                .order_by(col(models.Lens.name), col(models.Lens.camera))
            )
            return [
                LensRecord(
                    stored(lens.id), lens.name, lens.camera, version, approved_table_id(session, stored(lens.id))
                )
                for lens, version in session.exec(query)
            ]

        return await self._database.read(work)

    async def list_tables(self, lens_id: int) -> list[TableSummary]:
        """The tables of a lens, newest first. Raises :class:`NotFound` for the lens."""

        def work(session: Session) -> list[TableSummary]:
            require_lens(session, lens_id)
            query = table_rows().where(models.Table.lens_id == lens_id).order_by(col(models.Table.version).desc())
            approved_id = approved_table_id(session, lens_id)
            return [table_summary(row, approved_id) for row in session.exec(query)]

        return await self._database.read(work)

    async def latest_table(self, lens_id: int) -> TableRecord:
        """The newest table of a lens. Raises :class:`NotFound`."""

        def work(session: Session) -> TableRecord:
            require_lens(session, lens_id)
            row = _newest(session, lens_id)
            if row is None:
                raise NotFound("lens table of lens", lens_id)
            return table_record(row, approved_table_id(session, lens_id))

        return await self._database.read(work)

    async def approved_table(self, lens_id: int) -> TableRecord | None:
        """The approved table of a lens, None while there is none. Raises :class:`NotFound` for the lens."""

        def work(session: Session) -> TableRecord | None:
            require_lens(session, lens_id)
            approved_id = approved_table_id(session, lens_id)
            return None if approved_id is None else table_record(_find_table(session, approved_id), approved_id)

        return await self._database.read(work)

    async def approve_table(self, table_id: int, *, by: str | None = None, note: str | None = None) -> TableSummary:
        """Make a table the approved one of its lens; one that is approved already stays so, and nothing is added.

        Raises :class:`NotFound`.
        """
        now = self._now()

        def work(session: Session) -> TableSummary:
            row = _find_table(session, table_id)
            approved_id = approved_table_id(session, row.lens_id)
            if approved_id != table_id:
                _add_action(session, row, TableAction.APPROVED, now, by, note, approved_id)
            return table_summary(row, table_id)

        return await self._database.write(work)

    async def roll_back_table(self, table_id: int, *, by: str | None = None, note: str | None = None) -> TableSummary:
        """Take the approval of ``table_id`` back: the table approved before it is approved again, and given back.

        ``table_id`` must be the approved one, so that the same call again takes nothing more back. Raises
        :class:`NotApproved`, :class:`NothingBefore`, :class:`NotFound`.
        """
        now = self._now()

        def work(session: Session) -> TableSummary:
            row = _find_table(session, table_id)
            approved_id = approved_table_id(session, row.lens_id)
            if approved_id != table_id:
                raise NotApproved(table_id, approved_id)
            query = select(models.TableAction.kind, models.TableAction.table_id).where(
                models.TableAction.lens_id == row.lens_id
            )
            standing = standing_approvals(session.exec(query.order_by(col(models.TableAction.number))))
            if len(standing) < 2:
                raise NothingBefore(table_id)
            before = _find_table(session, standing[-2])
            _add_action(session, before, TableAction.ROLLED_BACK, now, by, note, table_id)
            return table_summary(before, standing[-2])

        return await self._database.write(work)

    async def note_published(self, table_id: int, *, by: str | None = None, note: str | None = None) -> ActionRecord:
        """Note that a table was written to an engine (``note``: which one, and how well). Raises :class:`NotFound`."""
        now = self._now()

        def work(session: Session) -> ActionRecord:
            row = _find_table(session, table_id)
            return action_record(_add_action(session, row, TableAction.PUBLISHED, now, by, note), row.version)

        return await self._database.write(work)

    async def table_history(self, table_id: int, limit: int = 200) -> list[ActionRecord]:
        """What was done with a table, and what took its approval, newest first. Raises :class:`NotFound`."""

        def work(session: Session) -> list[ActionRecord]:
            _find_table(session, table_id)
            action = models.TableAction
            query = (
                select(action, models.Table.version)
                .join(models.Table, col(models.Table.id) == col(action.table_id))
                .where((col(action.table_id) == table_id) | (col(action.replaces_id) == table_id))
            )
            newest = query.order_by(col(action.number).desc()).limit(page_limit(limit))
            return [action_record(row, version) for row, version in session.exec(newest)]

        return await self._database.read(work)


def standing_approvals(actions: Iterable[tuple[str, int]]) -> list[int]:
    """The tables of a lens whose approval was not taken back, from (kind, table id) in order; the last is approved.

    A roll back takes the last approval away; its table is the one before. A table may stand in it more than once.
    """
    standing: list[int] = []
    for kind, table_id in actions:
        if kind == TableAction.APPROVED:
            standing.append(table_id)
        elif kind == TableAction.ROLLED_BACK:
            standing.pop()
    return standing


def _find_table(session: Session, table_id: int) -> models.Table:
    row = session.get(models.Table, table_id)
    if row is None:
        raise NotFound("lens table", table_id)
    return row


def _lens_id(session: Session, name: str, camera: str) -> int | None:
    query = select(models.Lens.id).where(models.Lens.name == name, models.Lens.camera == camera)
    return session.exec(query).one_or_none()


def _newest(session: Session, lens_id: int) -> models.Table | None:
    query = select(models.Table).where(models.Table.lens_id == lens_id)
    return session.exec(query.order_by(col(models.Table.version).desc())).first()


def _refuse_other_picture(session: Session, table: LensTable, lens_id: int, approved_id: int | None) -> None:
    known = _newest(session, lens_id) if approved_id is None else _find_table(session, approved_id)
    if known is None:
        return
    difference = other_picture(read_json(known.document.encode()), table)
    if difference is not None:
        raise NameClash(table.lens, table.camera, difference)


def _provenance_text(table: LensTable) -> str | None:
    return None if table.provenance is None else to_json(asdict(table.provenance))


def _add_table(
    session: Session, table: LensTable, job_id: str | None, now: datetime, by: str | None, note: str | None
) -> TableSummary:
    """Store a table as the next version, and how it came, in the session's transaction."""
    lens_id = lens_id_of(session, table.lens, table.camera)
    last = session.exec(select(func.max(models.Table.version)).where(models.Table.lens_id == lens_id)).one()
    versioned = replace(table, version=1 + (last or 0))
    document = write_json(versioned)
    row = models.Table(
        lens_id=lens_id,
        version=versioned.version,
        created=versioned.created,
        document=document.decode(),
        job_id=job_id,
        sha256=hashlib.sha256(document).hexdigest(),
        provenance=_provenance_text(versioned),
    )
    session.add(row)
    session.flush()
    kind = TableAction.CALIBRATED
    if job_id is None:
        corrected = table.provenance is not None and table.provenance.source == TableAction.CORRECTED
        kind = TableAction.CORRECTED if corrected else TableAction.IMPORTED
    _add_action(session, row, kind, now, by, note)
    return table_summary(row, approved_table_id(session, lens_id))


def _add_action(
    session: Session,
    row: models.Table,
    kind: TableAction,
    now: datetime,
    by: str | None,
    note: str | None,
    replaces_id: int | None = None,
) -> models.TableAction:
    action = models.TableAction(
        lens_id=row.lens_id,
        table_id=stored(row.id),
        kind=kind.value,
        replaces_id=replaces_id,
        at=now,
        who=by,
        note=note,
    )
    session.add(action)
    session.flush()
    return action
