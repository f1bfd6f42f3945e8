"""The ``lensmatch`` command."""

from __future__ import annotations

import typer

from app.cli.demo import demo

cli = typer.Typer(
    name="lensmatch",
    help="Lens calibration for broadcast and virtual production: pictures in, lens table out.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
cli.command()(demo)


@cli.callback()
def _root() -> None:
    """Lens calibration for broadcast and virtual production: pictures in, lens table out."""


def main() -> None:
    """Entry point of the ``lensmatch`` command."""
    cli()


if __name__ == "__main__":
    main()
