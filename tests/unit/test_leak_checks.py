"""The checks of ``tests/conftest.py`` themselves: a test that leaves something behind really fails."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HEADER = """
import asyncio, socket, subprocess, sys, threading, time, warnings
import pytest
kept = []
"""
LEAKS = {
    "task": (
        "async def test_{}():\n    kept.append(asyncio.create_task(asyncio.sleep(60)))\n",
        "asyncio tasks left behind",
    ),
    "thread": (
        "def test_{}():\n    threading.Thread(target=time.sleep, args=(3,), name='forgotten').start()\n",
        "threads left behind: forgotten",
    ),
    "process": (
        "def test_{}():\n    kept.append(subprocess.Popen([sys.executable, '-c', 'input()'], stdin=subprocess.PIPE))\n",
        "child processes left behind",
    ),
    "dropped_socket": ("def test_{}():\n    socket.socket()\n", "unclosed <socket"),
    "dropped_file": ("def test_{}(tmp_path):\n    open(tmp_path / 'dropped.txt', 'w')\n", "unclosed file"),
    "warning": ("def test_{}():\n    warnings.warn('old', DeprecationWarning)\n", "DeprecationWarning: old"),
    "coroutine": ("async def test_{}():\n    asyncio.sleep(1)\n", "was never awaited"),
}
KEPT_OPEN = {
    "kept_socket": ("def test_{}():\n    kept.append(socket.socket())\n", "files or sockets left open: socket:"),
    "kept_file": ("def test_{}(tmp_path):\n    kept.append(open(tmp_path / 'kept.txt', 'w'))\n", "kept.txt"),
}
"""What is open and kept alive is told on Linux only."""
CLEAN = """
async def test_tasks_that_end():
    async with asyncio.TaskGroup() as group:
        group.create_task(asyncio.sleep(0))
    cancelled = asyncio.create_task(asyncio.sleep(60))
    await asyncio.sleep(0)
    cancelled.cancel()
    await asyncio.to_thread(time.sleep, 0)


def test_things_that_are_closed(tmp_path):
    with socket.socket(), open(tmp_path / "closed.txt", "w"):
        pass
    thread = threading.Thread(target=time.sleep, args=(0.1,))
    thread.start()
    subprocess.run([sys.executable, "-c", ""], check=True)
"""


def _run(body: str, folder: Path, repository: Path) -> subprocess.CompletedProcess[str]:
    """Run one test file beside a copy of the conftest, with the project's pytest settings."""
    (folder / "conftest.py").write_text((repository / "tests" / "conftest.py").read_text("utf-8"), "utf-8")
    (folder / "test_sample.py").write_text(HEADER + body, "utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", str(repository / "pyproject.toml")]
    return subprocess.run(
        [*command, f"--rootdir={folder}", str(folder)], capture_output=True, text=True, timeout=60, check=False
    )


def test_each_leak_fails_its_test(tmp_path: Path, repository: Path) -> None:
    leaks = LEAKS | (KEPT_OPEN if Path("/proc/self/fd").is_dir() else {})
    done = _run("\n\n".join(body.format(name) for name, (body, _) in leaks.items()), tmp_path, repository)
    assert done.returncode == 1, done.stdout + done.stderr
    for name, (_, told) in leaks.items():
        _, _, report = done.stdout.partition(f" test_{name} ")
        report, _, _ = report.partition("\n______")
        assert told in report, f"{name}: {done.stdout}"


def test_tests_that_clean_up_pass(tmp_path: Path, repository: Path) -> None:
    done = _run(CLEAN, tmp_path, repository)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 passed" in done.stdout
