"""The ``lensmatch`` command: every subcommand put together."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated, Any

import typer
from rich.markup import escape
from typer.core import TyperGroup

from app.cli.bench import bench
from app.cli.calibrate import calibrate
from app.cli.console import EXIT_FAILED, EXIT_USAGE, messages
from app.cli.demo import demo
from app.cli.detect import detect
from app.cli.doctor import doctor
from app.cli.exports import export_table, import_table
from app.cli.plot import plot
from app.cli.publish import publish
from app.cli.recheck import recheck
from app.cli.run import run
from app.cli.serve import serve
from app.cli.simulate import simulate
from app.cli.versions import compare, tables

_CALIBRATE = "Calibrate"
_TABLES = "Lens tables"
_STUDIO = "Service and studio"
_CHECK = "Check"

_INTERRUPTED = 130


class OneLineErrors(TyperGroup):
    """Wrong usage in one line instead of a box, with the exit codes of :mod:`app.cli.console`."""

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> Any:
        """Run; exits with the command's code (standalone) or gives it back."""
        try:
            code = super().main(args, prog_name, complete_var, False, windows_expand_args, **extra)
        except Exception as error:
            # What the parser raises has these two, whichever parser this version of typer brings along.
            if not (hasattr(error, "format_message") and hasattr(error, "exit_code")):
                raise
            context = getattr(error, "ctx", None)
            command = context.command_path if context is not None else "lensmatch"
            told = " ".join(str(error.format_message()).split()).rstrip(".")
            messages.print(f"[bold red]error:[/] {escape(told)}; see {escape(command)} --help")
            code = EXIT_USAGE
        if code == _INTERRUPTED:
            code = EXIT_FAILED
        if standalone_mode:
            sys.exit(code or 0)
        return code


cli = typer.Typer(
    name="lensmatch",
    cls=OneLineErrors,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _examples(*lines: str) -> str:
    return "\n\n".join(("[dim]Examples:[/]", *lines))


cli.command(rich_help_panel=_CALIBRATE, epilog=_examples("lensmatch demo", "lensmatch demo --zooms 2 --focuses 1"))(
    demo
)
cli.command(
    rich_help_panel=_CALIBRATE,
    epilog=_examples("lensmatch calibrate FOLDER --out table.json", "lensmatch calibrate FOLDER --method alternating"),
)(calibrate)
cli.command(
    rich_help_panel=_CALIBRATE, epilog=_examples("lensmatch run job.json --studio studio.toml --out table.json")
)(run)
cli.command(
    rich_help_panel=_CALIBRATE,
    epilog=_examples(
        "lensmatch detect 01.png --target chessboard:10x7", "lensmatch detect 01.png --target square --json"
    ),
)(detect)
cli.command(
    "export",
    rich_help_panel=_TABLES,
    epilog=_examples(
        "lensmatch export table.json --format csv --out table.csv",
        "lensmatch export table.json --format stmap --zoom 0.5 --focus 0 --overscan 1.15 --out maps.zip",
    ),
)(export_table)
cli.command(
    "import",
    rich_help_panel=_TABLES,
    epilog=_examples(
        "lensmatch import table.csv --format csv", "lensmatch import table.csv --format csv --out table.json"
    ),
)(import_table)
cli.command(
    rich_help_panel=_TABLES,
    epilog=_examples("lensmatch compare before.json after.json", "lensmatch compare before.json after.json --json"),
)(compare)
cli.command(
    rich_help_panel=_TABLES,
    epilog=_examples(
        "lensmatch plot table.json --out curves.svg",
        "lensmatch plot table.json --kind grid --zoom 0 --focus 0 --out grid.png",
        "lensmatch plot before.json --kind comparison --with after.json --out apart.svg",
    ),
)(plot)
cli.command(
    rich_help_panel=_TABLES,
    epilog=_examples("lensmatch tables", "lensmatch tables --database lensmatch-demo/lensmatch.db"),
)(tables)
cli.command(
    rich_help_panel=_TABLES,
    epilog=_examples(
        "lensmatch publish table.json --studio studio.toml --room job.json",
        "lensmatch publish table.json --zoom 0.5 --focus 0.25 --all-levels --room job.json",
    ),
)(publish)
cli.command(
    rich_help_panel=_TABLES,
    epilog=_examples(
        "lensmatch recheck table.json --studio studio.toml --room job.json",
        "lensmatch recheck table.json --room job.json --at 0.1,0.5 --at 0.9,0.5 --out corrected.json",
    ),
)(recheck)
cli.command(
    rich_help_panel=_STUDIO, epilog=_examples("lensmatch serve", "lensmatch serve --port 8080 --profile studio.toml")
)(serve)
cli.command(
    rich_help_panel=_STUDIO,
    epilog=_examples(
        "lensmatch simulate",
        "lensmatch simulate --r3-port 0 --mockboard-port 0 --head-port 0",
        "lensmatch simulate --fault r3:late=0.5@3 --fault 'mockboard:stale@40..42'",
    ),
)(simulate)
cli.command(
    rich_help_panel=_CHECK,
    epilog=_examples(
        "lensmatch bench detect --quick",
        "lensmatch bench levels --json figures.json",
        "lensmatch bench --report bench.html",
    ),
)(bench)
cli.command(
    rich_help_panel=_CHECK,
    epilog=_examples(
        "lensmatch doctor", "lensmatch doctor --print-profile > studio.toml", "lensmatch doctor --studio studio.toml"
    ),
)(doctor)


def product_version() -> str:
    """The installed version, or that it runs from a checkout."""
    try:
        return version("lensmatch")
    except PackageNotFoundError:
        return "not installed, run from a checkout"


def _print_version(wanted: bool) -> None:
    if wanted:
        sys.stdout.write(f"lensmatch {product_version()}\n")
        raise typer.Exit


@cli.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="show what the parts log, on standard error")
    ] = False,
    show_version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="print the version and stop")
    ] = False,
) -> None:
    """Lens calibration for broadcast and virtual production: pictures in, lens table out.

    Exit codes: 0 done, 1 the work failed (with the reason), 2 wrong usage. With --json work that failed prints one JSON
    document too: its "error" is the line of standard error, its "levels", where there are any, are those that failed.
    """
    if verbose:
        logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(levelname)s %(name)s: %(message)s")
    elif context.invoked_subcommand != "serve" and not logging.getLogger().handlers:
        # What goes wrong comes as one line at the end; the warnings on the way there would only double it.
        logging.getLogger().addHandler(logging.NullHandler())
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
        raise typer.Exit(EXIT_USAGE)
