"""Alembic's entry point: runs the revisions on the connection that :mod:`storage.database` hands over.

The connection is already in a transaction, and SQLite rolls back schema changes too: an upgrade that is killed or
fails leaves the old schema.
"""

from __future__ import annotations

from alembic import context

context.configure(connection=context.config.attributes["connection"])
with context.begin_transaction():
    context.run_migrations()
