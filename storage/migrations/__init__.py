"""Alembic migrations, run by :mod:`storage.database` when a database is opened; no ``alembic.ini`` is needed."""
