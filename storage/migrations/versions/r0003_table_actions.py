"""The ledger of table actions, and each table's provenance beside its document.

Revision ID: 0003
Revises: 0002
"""

from __future__ import annotations

import json

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision: str | None = "0002"
branch_labels: str | None = None
depends_on: str | None = None

_GUARDED = {"tables": "lens tables never change", "table_actions": "table actions are append-only"}


def _provenance(document: str) -> str | None:
    try:
        provenance = json.loads(document).get("provenance")
    except (ValueError, AttributeError):
        return None  # a damaged document says so where it is read; the rest of the database is of use without it
    if provenance is None:
        return None
    return json.dumps(provenance, sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def upgrade() -> None:
    """Make the ledger and what guards it; tables of before have no actions, and the provenance their document has."""
    op.create_table(
        "table_actions",
        sa.Column("number", sa.Integer(), primary_key=True),
        sa.Column("lens_id", sa.Integer(), sa.ForeignKey("lenses.id"), nullable=False),
        sa.Column("table_id", sa.Integer(), sa.ForeignKey("tables.id"), nullable=False),
        sa.Column("kind", sa.Text(), nullable=False),
        sa.Column("replaces_id", sa.Integer(), sa.ForeignKey("tables.id")),
        sa.Column("at", sa.Text(), nullable=False),
        sa.Column("who", sa.Text()),
        sa.Column("note", sa.Text()),
    )
    op.create_index("actions_of_a_lens", "table_actions", ["lens_id", "number"])
    op.add_column("tables", sa.Column("provenance", sa.Text()))
    connection = op.get_bind()
    ids = [row[0] for row in connection.execute(sa.text("SELECT id FROM tables ORDER BY id"))]
    for table_id in ids:  # one at a time: a document may have megabytes
        document = connection.execute(sa.text("SELECT document FROM tables WHERE id = :id"), {"id": table_id}).scalar()
        provenance = _provenance(str(document))
        if provenance is not None:
            connection.execute(
                sa.text("UPDATE tables SET provenance = :text WHERE id = :id"), {"text": provenance, "id": table_id}
            )
    for table, why in _GUARDED.items():
        for change in ("UPDATE", "DELETE"):
            op.execute(
                f"CREATE TRIGGER {table}_refuse_{change.lower()} BEFORE {change} ON {table} "
                f"BEGIN SELECT RAISE(ABORT, '{why}'); END"
            )
