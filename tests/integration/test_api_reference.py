"""The written reference of the service is what the service does."""

from __future__ import annotations

import json
from pathlib import Path

import httpx

from app.api import errors, sockets
from app.api.context import AppContext
from app.main import create_app
from app.reference import pages


def test_the_reference_is_current(repository: Path) -> None:
    made = pages()
    assert {
        "openapi.json",
        "events.schema.json",
        "job.schema.json",
        "publish.schema.json",
        "picture-set.schema.json",
    } <= made.keys()
    for name, text in made.items():
        written = (repository / "docs" / "reference" / name).read_text("utf-8")
        assert written == text, f"{name}: run python -m app.reference docs/reference"


async def test_the_service_describes_itself(client: httpx.AsyncClient, repository: Path) -> None:
    told = (await client.get("/api/v1/openapi.json")).json()
    assert told == json.loads((repository / "docs" / "reference" / "openapi.json").read_text("utf-8"))
    assert "ProblemDocument" in told["components"]["schemas"]


def test_every_route_problem_and_close_code_is_documented(repository: Path, context: AppContext) -> None:
    page = (repository / "docs" / "reference" / "rest.md").read_text("utf-8")
    for path, methods in create_app(context).openapi()["paths"].items():
        for method in methods:
            told = f"`{method.upper()} {path.removeprefix('/api/v1')}"
            assert f"{told}`" in page or f"{told}?" in page, told
    for name, kind in errors.PROBLEMS.items():
        assert f"| `{name}` | {kind.status} |" in page, name
    for code in sockets.CLOSE_CODES:
        assert f"| {code} |" in page, code


def test_every_event_and_field_is_documented(repository: Path) -> None:
    page = (repository / "docs" / "reference" / "events.md").read_text("utf-8")
    schema = json.loads((repository / "docs" / "reference" / "events.schema.json").read_text("utf-8"))
    rows = {line.split("|")[1].strip(" `"): line for line in page.splitlines() if line.startswith("| `")}
    for kind, place in schema["discriminator"]["mapping"].items():
        row = rows[kind]
        common = {"seq", "at", "kind", "job_id", "number", "ordinal", "zoom", "focus"}
        for field in set(schema["$defs"][place.rpartition("/")[2]]["properties"]) - common:
            assert f"`{field}`" in row, f"{kind}: {field}"
