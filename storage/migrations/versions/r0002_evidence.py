"""The evidence of each level, beside it.

Revision ID: 0002
Revises: 0001
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision: str | None = "0001"
branch_labels: str | None = None
depends_on: str | None = None


def upgrade() -> None:
    """Make the table; levels of before have no evidence."""
    op.create_table(
        "evidence",
        sa.Column("level_id", sa.Integer(), sa.ForeignKey("levels.id"), primary_key=True),
        sa.Column("document", sa.LargeBinary(), nullable=False),
        sa.Column("sha256", sa.Text(), nullable=False),
    )
