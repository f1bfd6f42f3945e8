"""What the integration tests share: the command line as a process of its own."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

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
