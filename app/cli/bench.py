"""``lensmatch bench``: accuracy and speed, side by side with their baselines."""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from app.cli.console import check_out, print_json, progress_bar, reported_errors, say, write_file, wrong_usage
from app.cli.tables import plain_table, print_table
from app.documents import DocumentError
from app.report.bench import BenchSection, bench_page
from benchmarks.registry import BENCHMARKS, Benchmark, machine
from benchmarks.rows import Row


def bench(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help=f"{', '.join(BENCHMARKS)}; without one: all")
    ] = None,
    json_out: Annotated[
        str | None, typer.Option("--json", metavar="PATH", help="write the figures as JSON; - prints them")
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option("--report", metavar="PATH", dir_okay=False, help="write tables and plots as one HTML page"),
    ] = None,
    lenses: Annotated[
        Path | None,
        typer.Option("--lenses", metavar="FILE", dir_okay=False, help="for lens: real lenses to judge by, as JSON"),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="a small share of the cases, to see that it runs")] = False,
) -> None:
    """Run the benchmarks and print their figures beside those of the study's method and of public tools."""
    with reported_errors(json_out == "-"):
        for name in names or ():
            if name not in BENCHMARKS:
                wrong_usage(f"no benchmark is called {name!r}; there are: {', '.join(BENCHMARKS)}")
        chosen = [BENCHMARKS[name] for name in dict.fromkeys(names or BENCHMARKS)]
        if lenses is not None and not any(benchmark.takes_lenses for benchmark in chosen):
            wrong_usage("--lenses is for the benchmark lens")
        out = Path(json_out) if json_out not in (None, "-") else None
        check_out(out)
        check_out(report)
        documents = []
        sections = []
        for benchmark in chosen:
            rows = _run(benchmark, quick, lenses)
            documents.append({"name": benchmark.name, "machine": machine(), "rows": _finite(rows)})
            columns = benchmark.columns(rows)
            sections.append(BenchSection(benchmark.name, benchmark.title, rows, columns, benchmark.plots))
            if json_out != "-":
                _show(benchmark, rows)
        if report is not None:
            page = bench_page(sections, machine(), datetime.now(UTC))
            write_file(report, page.encode())
            say(f"report: {report}")
        document: Any = documents[0] if len(documents) == 1 else documents
        if json_out == "-":
            print_json(document)
        elif out is not None:
            write_file(out, json.dumps(document, indent=1, allow_nan=False).encode() + b"\n")
            say(f"figures: {out}")


def _run(benchmark: Benchmark, quick: bool, lenses: Path | None) -> list[Row]:
    with progress_bar(f"bench {benchmark.name}") as show:
        try:
            return benchmark.run(quick=quick, progress=lambda share: show(share, benchmark.title), lenses=lenses)
        except ValueError as error:
            if lenses is None:
                raise
            raise DocumentError(str(error)) from error


def _show(benchmark: Benchmark, rows: list[Row]) -> None:
    columns = benchmark.columns(rows)
    table = plain_table(f"{benchmark.name}: {benchmark.title}", tuple(name for name, _ in columns))
    for column in table.columns[:2]:
        column.justify = "left"
    for row in rows:
        table.add_row(*(text(row.get(name)) for name, text in columns))
    print_table(table)


def _finite(rows: list[Row]) -> list[Row]:
    """Rows as JSON has them: what is no number is null."""
    return [
        {key: None if isinstance(v, float) and not math.isfinite(v) else v for key, v in row.items()} for row in rows
    ]
