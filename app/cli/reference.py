"""Writes ``docs/reference/cli.md`` from the commands themselves; a test checks that it is current.

``python -m app.cli.reference docs/reference/cli.md``
"""

from __future__ import annotations

import inspect
import sys
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from typer.models import ArgumentInfo

from app.cli.commands import cli

_NEEDED = "needed"

_HEAD = """# Command line

Made from the commands by `python -m app.cli.reference docs/reference/cli.md`.

```bash run
lensmatch --help
```

"""

_RULES = """
`SPEC` of a target: `chessboard:COLSxROWS` (squares, not inner corners), `square`, `light`.

## What every command keeps to

- `--json` prints one JSON document on standard output, and nothing else there. Progress and messages go to standard
  error. A command that fails prints one too: `{"error":}`, the line of standard error, and where `calibrate`, `run` or
  `demo` know it, `"levels": [{"zoom":, "focus":, "reason":}]`, the levels that failed. Only a command line that cannot
  be parsed at all leaves standard output empty.
- Exit code 0: done. 1: the work failed, with the reason in one line. 2: wrong usage, which is what the command line
  alone tells; a file or an engine that is not there is work that failed.
- A file is written whole or not at all. `--out` is checked before the work begins.
- Ctrl-C ends the work, keeps what is finished and gives the engine its values back; `run` and `demo` say which job in
  which database keeps how many levels. Values that could not be put back are named in a warning, to be set by hand.
- `lensmatch --verbose COMMAND` shows the log on standard error; `lensmatch --install-completion` completes commands
  and options in your shell.

## What `--json` prints

| command | document |
| --- | --- |
"""

_DOCUMENTS = {
    "`demo`": '`{"table": <lens table>, "truth": <truth file>, "overlay_px": {"rms":, "max":}, "pictures": n, '
    '"seconds": s}`',
    "`calibrate`, `run`, `import`": "the [lens table](lens-table.md)",
    "`detect`": '`{"found": true, "kind":, "points": [[u, v], ...], "point_ids": [...], '
    '"covariance": [[[uu, uv], [uv, vv]], ...], "centre": [u, v], "blur_px":, '
    '"quality": {"score":, "contrast":, "fit_chi2":, "grid_rms_px":}, "seconds":}`, points row by row, `point_ids` '
    "which of the target's points each one is (a board may be partly hidden), `null` what is not told; or "
    '`{"found": false, "reason":, "error":}` with exit code 1',
    "`compare`": '`{"first":, "second":, "verdict":, "agree":, "most_sigmas":, "difference_px": {"rms":, "max":}, '
    '"worst": <level>, "levels": [{"zoom":, "focus":, "measured": [true, true], "difference_px":, "worst_px":, '
    '"center_shift_px":, "f_ratio":, "sigma_px":, "sigmas":, "reason":}], "explanations": [{"cause":, '
    '"center_shift_px":, "f_ratio":, "left_px":}], "map": {"zooms":, "focuses":, "rms_px":, "max_px":}}`, `null` what '
    "is not told",
    "`tables`": '`{"database":, "tables": [{"id":, "lens":, "camera":, "version":, "approved":, "created":, '
    '"job_id":, "sha256":, "provenance":}]}`',
    "`publish`": '`{"published":, "zoom":, "focus":, "compared":, "render_px": {"rms":, "max":}, "reason":, "places": '
    '[{"zoom":, "focus":, "values": [{"name":, "asked":, "got":, "same":}], "compared":, "renders":, "render_px":, '
    '"limit_px":, "reason":, "ok":}], "job":}`, `null` what is not told; a publication that failed has `"error":` '
    "besides",
    "`plot`": '`{"out":, "kind":}`',
    "`recheck`": '`{"verdict": "holds", "corrected" or "changed", "goal_px":, "error_px":, "left_px":, "remount": '
    '{"center_shift_px":, "center_shift_sigma_px":, "zoom_offset":, "zoom_offset_sigma":, "focus_offset":, '
    '"focus_offset_sigma":}, "levels": [{"zoom":, "focus":, "error_px":, "expected_px":, "left_px":}], '
    '"corrected_table_id":, "reason":, "job":}`, `null` what is not told; `changed` is exit code 1 without `"error":`',
    "`export`": '`{"out":, "format":, "cannot_carry": [...]}`',
    "`serve`": '`{"url":, "pid":, "database":}` when it is ready',
    "`simulate`": "one line with the addresses `r3`, `mockboard`, `head`, and `pid`, `lens`, `room`, `projects`, "
    "`survey`, when it is ready; with or without `--json`",
    "`bench`": '`--json PATH` writes `{"name":, "machine":, "rows": [{"case":, "method":, figures...}]}`, a list of '
    "them for several names; `--json -` prints it",
    "`doctor`": '`{"ok":, "checks": [{"name":, "ok":, "detail":, "advice":}]}`',
}


@dataclass(frozen=True, slots=True)
class _Parameter:
    """An argument or option as its function's signature declares it."""

    shown: str
    is_argument: bool
    default: str
    help: str


def reference_text() -> str:
    """``docs/reference/cli.md``: every command with its arguments, options, defaults and examples."""
    lines = ["| command | does |", "| --- | --- |"]
    sections = []
    for info in cli.registered_commands:
        function = info.callback
        if function is None:
            continue
        name = info.name or function.__name__
        lines.append(f"| [`lensmatch {name}`](#lensmatch-{name}) | {_paragraphs(function.__doc__)[0]} |")
        sections.append(_section(name, function, info.epilog))
    documents = "".join(f"| {command} | {document} |\n" for command, document in _DOCUMENTS.items())
    return _HEAD + "\n".join(lines) + "\n" + _RULES + documents + "".join(f"\n{section}" for section in sections)


def _section(name: str, function: Callable[..., Any], epilog: str | None) -> str:
    parameters = sorted(_parameters(function), key=lambda parameter: not parameter.is_argument)
    needed = "".join(f" {p.shown}" for p in parameters if p.is_argument or p.default == _NEEDED)
    lines = [f"## lensmatch {name}", "", f"`lensmatch {name}{needed} [OPTIONS]`", ""]
    for paragraph in _paragraphs(function.__doc__):
        lines += [paragraph, ""]
    lines += ["| argument or option | default | what it is |", "| --- | --- | --- |"]
    lines += [f"| `{_cell(p.shown)}` | {p.default} | {_cell(p.help)} |" for p in parameters]
    lines += ["", "```", *_paragraphs(epilog)[1:], "```"]
    return "\n".join(lines) + "\n"


def _parameters(function: Callable[..., Any]) -> Iterator[_Parameter]:
    hints = typing.get_type_hints(function, include_extras=True)
    for name, parameter in inspect.signature(function).parameters.items():
        kind, info = typing.get_args(hints[name])[:2]
        is_argument = isinstance(info, ArgumentInfo)
        if is_argument:
            shown = info.metavar or name.upper()
        else:
            # The first name of an annotated option stands where an unannotated one has its default.
            given = [decl for decl in (info.default, *(info.param_decls or ())) if isinstance(decl, str)]
            shown = ", ".join(given or [f"--{name.replace('_', '-')}"])
            shown += "" if kind is bool else f" {info.metavar or _metavar(kind)}"
        default = _NEEDED if parameter.default is inspect.Parameter.empty else _default(kind, parameter.default)
        yield _Parameter(shown, is_argument, default, info.help or "")


def _metavar(kind: Any) -> str:
    """What stands for a value of this type; that of the items for a list, that of the value for one or None."""
    parts = [part for part in typing.get_args(kind) if part is not type(None)]
    if parts:
        return _metavar(parts[0])
    if isinstance(kind, type) and issubclass(kind, Enum):
        return "|".join(str(choice.value) for choice in kind)
    return {Path: "PATH", int: "INT", float: "NUMBER"}.get(kind, "TEXT")


def _default(kind: Any, value: Any) -> str:
    if value is None or kind is bool:
        return ""
    return f"`{value.value if isinstance(value, Enum) else value}`"


def _paragraphs(text: str | None) -> list[str]:
    return [" ".join(part.split()) for part in inspect.cleandoc(text or "").split("\n\n")]


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(reference_text(), "utf-8", newline="\n")
