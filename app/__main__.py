"""The ``lensmatch`` command."""

from __future__ import annotations

import io
import sys

from app.cli.commands import cli


def main() -> None:
    """Entry point of the ``lensmatch`` command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # Redirected, Windows would write in its old code page; a lens may have any name.
            stream.reconfigure(encoding=None if stream.isatty() else "utf-8", errors="backslashreplace")
    cli(prog_name="lensmatch")


if __name__ == "__main__":
    main()
