"""What a person or a script sees: progress and messages on standard error, results on standard output, exit codes.

0: done. 1: the work failed, with the reason in one line. 2: wrong usage, which is what the command line alone tells;
a file or an engine that is not there is work that failed.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from app.documents import DocumentError
from app.engines import EngineError
from app.errors import ServiceError
from calibration.errors import CalibrationError
from calibration.tables import LevelResult, LevelStatus
from engine_adapters.errors import AdapterError
from storage.errors import StorageError

EXIT_FAILED = 1
EXIT_USAGE = 2

KNOWN_ERRORS = (AdapterError, CalibrationError, DocumentError, EngineError, ServiceError, StorageError)

messages = Console(stderr=True, highlight=False, soft_wrap=True, emoji=False)
results = Console(highlight=False, soft_wrap=True, emoji=False)

Show = Callable[[float, str], None]
"""Told how far the work is (0..1) and what is being done."""


_printed = [0]
"""How many JSON documents went to standard output in this process."""


class WorkFailed(Exception):
    """The work failed, and the message is why; the command exits with 1. ``levels``: what became of each, if known."""

    def __init__(self, message: str, levels: Iterable[LevelResult] = ()) -> None:
        self.levels = tuple(levels)
        super().__init__(message)


class WrongUsage(Exception):
    """The command line asks for what there is not; the command exits with 2."""


@contextlib.contextmanager
def reported_errors(as_json: bool = False) -> Iterator[None]:
    """Turn expected errors into one line on standard error and the right exit code.

    With ``as_json`` also into the JSON document ``{"error": line}`` on standard output, with the failed ``levels``
    where they are known, unless the command has printed its own document already.
    """
    before = _printed[0]
    code, levels = EXIT_FAILED, []
    try:
        yield
        return
    except WrongUsage as error:
        told, code = str(error), EXIT_USAGE
    except (*KNOWN_ERRORS, WorkFailed) as error:
        told = str(error) or type(error).__name__
        levels = failed_levels(error.levels) if isinstance(error, WorkFailed) else []
    except OSError as error:
        told = os_reason(error)
    except KeyboardInterrupt:
        told = "interrupted; what was finished is kept"
    if as_json and _printed[0] == before:
        print_json({"error": _flat(told)} | ({"levels": levels} if levels else {}))
    fail(told, code)


def failed_levels(levels: Iterable[LevelResult]) -> list[dict[str, Any]]:
    """The levels that failed, each with its reason, as JSON documents tell them."""
    return [
        {"zoom": level.zoom, "focus": level.focus, "reason": level.reason or "unknown"}
        for level in levels
        if level.status is LevelStatus.FAILED
    ]


def os_reason(error: OSError) -> str:
    """The file and what the system says of it, without its error number."""
    reason = error.strerror or str(error) or type(error).__name__
    if isinstance(error, FileExistsError):
        reason = "is a file already, not a folder; give another name"
    return f"{error.filename}: {reason}" if error.filename else reason


def fail(message: str, code: int) -> NoReturn:
    """One line on standard error, then exit."""
    messages.print(f"[bold red]error:[/] {_one_line(message)}")
    raise typer.Exit(code)


def wrong_usage(message: str) -> NoReturn:
    """Say what is wrong with the command line and exit with 2; inside :func:`reported_errors`."""
    raise WrongUsage(message)


def warn(message: str) -> None:
    """A line for a person of what needs their hand."""
    messages.print(f"[bold yellow]warning:[/] {_one_line(message)}")


def say(message: str) -> None:
    """A line for a person."""
    messages.print(escape(message))


def print_json(document: Any) -> None:
    """One JSON document on standard output; NaN and infinity, which JSON has not, are an error of ours."""
    sys.stdout.write(json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False) + "\n")
    sys.stdout.flush()
    _printed[0] += 1


def check_out(*paths: Path | None) -> None:
    """Refuse, before any work is done, a file that could not be written at its end. Raises :class:`WorkFailed`."""
    for path in paths:
        if path is None:
            continue
        folder = path.parent
        if path.is_dir():
            raise WorkFailed(f"{path}: is a folder; give the name of a file in it")
        if not folder.is_dir():
            raise WorkFailed(f"{path}: cannot be written, there is no folder {folder}; make it first")
        if not os.access(folder, os.W_OK):
            raise WorkFailed(f"{path}: cannot be written, the folder {folder} does not allow it; choose another")


def write_file(path: Path, data: bytes) -> None:
    """Write a whole file or none: beside it first, then put in its place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".part")
    try:
        beside.write_bytes(data)
        beside.replace(path)
    finally:
        with contextlib.suppress(OSError):  # never instead of the error that led here
            beside.unlink(missing_ok=True)


def read_file(path: Path, limit_bytes: int) -> bytes:
    """A whole file. Raises :class:`app.documents.DocumentError` in one line; nothing larger than the limit is read."""
    try:
        if path.is_dir():
            raise DocumentError(f"{path}: is a folder, not a file")
        with path.open("rb") as file:
            data = file.read(limit_bytes + 1)
    except FileNotFoundError as error:
        raise DocumentError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = error.strerror if isinstance(error, OSError) else None
        raise DocumentError(f"{path}: cannot be read ({reason or error})") from error
    if len(data) > limit_bytes:
        raise DocumentError(f"{path}: larger than {limit_bytes // 2**20} MiB; this is another kind of file")
    return data


@contextlib.contextmanager
def progress_bar(title: str) -> Iterator[Show]:
    """A bar on standard error; the callable takes the share done (0..1) and what is being done.

    Where nobody watches a terminal it is a line for each tenth.
    """
    if not messages.is_terminal:
        with progress_lines(title, each=0.1) as show_line:
            yield show_line
        return
    columns = (
        TextColumn("[bold]{task.description}"),
        BarColumn(bar_width=32),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("[dim]{task.fields[doing]}"),
    )
    with Progress(*columns, console=messages) as progress:
        task = progress.add_task(title, total=1.0, doing="")

        def show(share: float, doing: str) -> None:
            progress.update(task, completed=share, doing=escape(doing))

        yield show


@contextlib.contextmanager
def progress_lines(title: str, each: float | None = None) -> Iterator[Show]:
    """Progress as lines: one for each new thing that is done, or, with ``each``, one whenever this share more is done.

    Where a person types in the same terminal, a bar that redraws itself would garble what they type.
    """
    last: object = None

    def show(share: float, doing: str) -> None:
        nonlocal last
        mark = doing if each is None else int(share / each + 1e-9)
        if mark != last:
            last = mark
            messages.print(f"[dim]{escape(title)} {share:4.0%}  {escape(doing)}[/]")

    yield show


def _one_line(text: str) -> str:
    """Text with rich's markup signs made plain, on one line."""
    return escape(_flat(text))


def _flat(text: str) -> str:
    return " ".join(text.split())
