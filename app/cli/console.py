"""What a person or a script sees: progress and messages on standard error, results on standard output, exit codes.

0: done. 1: the work failed, with the reason in one line. 2: wrong usage.
"""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from app.documents import DocumentError
from app.engines import EngineError
from app.errors import ServiceError
from calibration.errors import CalibrationError
from engine_adapters.errors import AdapterError
from storage.errors import StorageError

EXIT_FAILED = 1
EXIT_USAGE = 2

KNOWN_ERRORS = (AdapterError, CalibrationError, DocumentError, EngineError, ServiceError, StorageError, OSError)

messages = Console(stderr=True, highlight=False, soft_wrap=True)
results = Console(highlight=False, soft_wrap=True)


class WorkFailed(Exception):
    """The work failed for a reason that has been told or is the message; the command exits with 1."""


@contextlib.contextmanager
def reported_errors() -> Iterator[None]:
    """Turn expected errors into one line on standard error and the right exit code."""
    try:
        yield
    except DocumentError as error:
        fail(str(error), EXIT_FAILED)
    except KNOWN_ERRORS as error:
        fail(str(error) or type(error).__name__, EXIT_FAILED)
    except WorkFailed as error:
        fail(str(error), EXIT_FAILED)
    except KeyboardInterrupt:
        fail("interrupted; what was finished is kept", EXIT_FAILED)


def fail(message: str, code: int) -> None:
    """One line on standard error, then exit."""
    messages.print(f"[bold red]error:[/] {_plain(message)}")
    raise typer.Exit(code)


def wrong_usage(message: str) -> None:
    """Say what is wrong with the command line and exit with 2."""
    fail(message, EXIT_USAGE)


def say(message: str) -> None:
    """A line for a person."""
    messages.print(_plain(message))


def print_json(document: Any) -> None:
    """One JSON document on standard output; NaN and infinity, which JSON has not, are an error of ours."""
    sys.stdout.write(json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def write_file(path: Path, data: bytes) -> None:
    """Write a whole file or none: beside it first, then put in its place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".part")
    try:
        beside.write_bytes(data)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


@contextlib.contextmanager
def progress_bar(title: str) -> Iterator[Callable[[float, str], None]]:
    """A bar on standard error; the callable takes the share done (0..1) and what is being done."""
    columns = (
        TextColumn("[bold]{task.description}"),
        BarColumn(bar_width=32),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("[dim]{task.fields[doing]}"),
    )
    with Progress(*columns, console=messages, transient=not messages.is_terminal) as progress:
        task = progress.add_task(title, total=1.0, doing="")

        def show(share: float, doing: str) -> None:
            progress.update(task, completed=share, doing=_plain(doing))

        yield show


def _plain(text: str) -> str:
    """Text with rich's markup signs made plain."""
    return text.replace("[", "\\[")
