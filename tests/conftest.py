"""What every test gets: the shared sample data, a fixed hypothesis profile, and a check that it leaves nothing behind.

A test fails when it leaves an asyncio task, a thread, a child process, or an open file or socket. Warnings are errors
(``pyproject.toml``), so an object that is collected while still open fails too; here it is also found when it is
kept alive.
"""

from __future__ import annotations

import asyncio
import gc
import inspect
import os
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path

import psutil
import pytest
from hypothesis import Phase, settings

REPOSITORY = Path(__file__).resolve().parents[1]
LEAVE_BOUND_S = 1.0
"""How long a thread or a child process may take to end after its test: they end on their own, not at once."""
FONTS = ".ttf"
"""Files that matplotlib keeps open for the whole run, as it should; an environment may stand inside the checkout."""
HELPERS = ("multiprocessing.resource_tracker", "multiprocessing.forkserver")
"""Children that the standard library starts once and keeps for the whole run."""

# The helpers in ``support`` check too: their failures tell what was compared, like those of the tests.
pytest.register_assert_rewrite("tests.support")

settings.register_profile(
    "house",
    derandomize=True,
    print_blob=True,
    deadline=None,
    database=None,
    # "explain" runs each failure many times more; the blob is enough to run it again.
    phases=(Phase.explicit, Phase.generate, Phase.shrink),
)
settings.load_profile("house")


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of sample data that other projects own: ``$LENSMATCH_SHARED/data``, else ``../shared/data``."""
    shared = Path(os.environ.get("LENSMATCH_SHARED") or REPOSITORY.parent / "shared")
    data = shared / "data"
    if not data.is_dir():
        pytest.skip(f"no sample data at {data}: set LENSMATCH_SHARED to the folder that holds it")
    return data


def _threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if not thread.daemon}


def _children() -> set[psutil.Process]:
    if hasattr(os, "waitid"):
        try:  # the system tells at once that there are none; looking for them goes through every process there is
            os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        except ChildProcessError:
            return set()
    return set(psutil.Process().children())


def _is_helper(child: psutil.Process) -> bool:
    try:
        line = " ".join(child.cmdline())
        return child.status() == psutil.STATUS_ZOMBIE or any(helper in line for helper in HELPERS)
    except psutil.NoSuchProcess:
        return True


def _open_files() -> dict[int, str]:
    """What this process holds open, by descriptor; empty where the system cannot tell cheaply (macOS, Windows)."""
    held: dict[int, str] = {}
    for entry in Path("/proc/self/fd").glob("*"):
        try:
            held[int(entry.name)] = os.readlink(entry)
        except OSError:  # the descriptor that lists the folder itself
            continue
    return held


def _new_files(before: dict[int, str]) -> list[str]:
    """Regular files and sockets that are open now and were not before, in words."""
    ours = (str(REPOSITORY), os.path.realpath(os.environ.get("TMPDIR", "/tmp")), "socket:")
    new = [name for number, name in _open_files().items() if before.get(number) != name and name.startswith(ours)]
    return [name for name in new if not name.endswith(FONTS)]


def _after_settling(left: Callable[[], list[str]]) -> list[str]:
    """What ``left`` names, once it names nothing or the bound is over."""
    bound = time.monotonic() + LEAVE_BOUND_S
    while (names := left()) and time.monotonic() < bound:
        time.sleep(0.01)
    return names


@pytest.fixture(autouse=True)
def _nothing_left_behind() -> Iterator[None]:
    """Fail a test that leaves a thread, a child process, or an open file or socket."""
    threads, children, files = _threads(), _children(), _open_files()
    yield
    problems = []
    if left := _after_settling(lambda: sorted(thread.name for thread in _threads() - threads)):
        problems.append(f"threads left behind: {', '.join(left)}")
    if left := _after_settling(lambda: [str(child) for child in _children() - children if not _is_helper(child)]):
        problems.append(f"child processes left behind: {', '.join(left)}")
    if _new_files(files):
        # Collecting costs tens of milliseconds, so only now: what nobody holds warns here, which is an error too.
        gc.collect()
        if left := _new_files(files):
            problems.append(f"files or sockets left open: {', '.join(sorted(left))}")
    if problems:
        pytest.fail("; ".join(problems))


@pytest.fixture
async def _no_tasks_left() -> AsyncIterator[None]:
    """For async tests: every task started in the test's loop has ended, by itself or because its owner ended it."""
    before = asyncio.all_tasks()
    yield
    left = asyncio.all_tasks() - before - {asyncio.current_task()}
    for _ in range(3):  # a task that was cancelled a moment ago ends in the next turns of the loop
        if not left:
            break
        await asyncio.sleep(0)
        left = {task for task in left if not task.done()}
    if left:
        pytest.fail("asyncio tasks left behind: " + "; ".join(sorted(repr(task) for task in left)))


@pytest.fixture(autouse=True)
def _no_tasks_left_by_async_tests(request: pytest.FixtureRequest, _nothing_left_behind: None) -> None:
    """Ask for the check above in async tests only; after ``_nothing_left_behind``, so that the loop ends before it."""
    if inspect.iscoroutinefunction(getattr(request.node, "obj", None)):
        request.getfixturevalue("_no_tasks_left")
