"""What the integration tests share: the command line as a process of its own, and the service over a real ledger."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import httpx
import pytest

from app.api.context import AppContext
from app.events import EventBroker
from app.main import create_app
from app.settings import Settings
from storage.repository import Repository
from tests.support.clock import Clock
from tests.support.service import KeepingRunner

COMMAND_BOUND_S = 90.0


class Lensmatch:
    """Runs ``python -m app`` in a folder of its own, with a database there."""

    def __init__(self, repository: Path, folder: Path) -> None:
        self.folder = folder
        self._environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith("LENSMATCH_")},
            "PYTHONPATH": str(repository),
            "LENSMATCH_DATABASE": str(folder / "lensmatch.db"),
            "LENSMATCH_CPU_WORKERS": "1",
        }

    async def __call__(self, *words: str | Path) -> subprocess.CompletedProcess[str]:
        """Run a command to its end."""
        async with self.started(*words) as process:
            out, err = await asyncio.wait_for(process.communicate(), COMMAND_BOUND_S)
        code = process.returncode
        assert code is not None
        return subprocess.CompletedProcess([*map(str, words)], code, out.decode(), err.decode())

    @asynccontextmanager
    async def started(self, *words: str | Path) -> AsyncIterator[asyncio.subprocess.Process]:
        """A command while it runs; ended on leaving."""
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "app", *map(str, words)),
            cwd=self.folder,
            env=self._environment,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        try:
            yield process
        finally:
            if process.returncode is None:
                process.kill()
            await process.communicate()


@pytest.fixture
def lensmatch(repository: Path, tmp_path: Path) -> Lensmatch:
    """The command line as a process; its working folder is ``tmp_path``."""
    return Lensmatch(repository, tmp_path)


@pytest.fixture(scope="session")
def empty_database(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A database file without rows: making its schema anew for each test would take most of the time."""
    path = tmp_path_factory.mktemp("empty") / "lensmatch.db"

    async def make() -> None:
        await (await Repository.open(path, Clock())).close()

    asyncio.run(make())
    return path.read_bytes()


@pytest.fixture
async def ledger(tmp_path: Path, empty_database: bytes) -> AsyncIterator[Repository]:
    """An empty ledger on a file of its own."""
    path = tmp_path / "lensmatch.db"
    path.write_bytes(empty_database)
    async with await Repository.open(path, Clock()) as opened:
        yield opened


@pytest.fixture
def context(ledger: Repository, tmp_path: Path) -> AppContext:
    """What the routes stand on, with a runner that runs nothing."""
    settings = Settings(
        database=tmp_path / "lensmatch.db",
        max_body_bytes=20_000,
        allowed_origins=("https://studio.example",),
        min_free_disk_bytes=0,
    )
    broker = EventBroker()
    return AppContext(settings, ledger, KeepingRunner(ledger), broker, Clock())


@pytest.fixture
async def client(context: AppContext) -> AsyncIterator[httpx.AsyncClient]:
    """A client of the service's application."""
    transport = httpx.ASGITransport(create_app(context), raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:8000") as opened:
        yield opened
