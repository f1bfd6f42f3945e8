"""What the service refuses, and what goes wrong in it: each a problem document that names what and where."""

from __future__ import annotations

import json
import logging
from collections.abc import AsyncIterator
from typing import Any

import httpx
import pytest

from app.api.context import AppContext
from app.main import create_app
from storage.errors import BadDocument, DatabaseUnusable, StorageBusy, StorageFull
from storage.repository import Repository
from tests.support.service import JOB, KeepingRunner, assert_problem, stored_job


@pytest.mark.parametrize(
    ("method", "path", "name"),
    [
        ("GET", "/", "not-found"),
        ("GET", "/docs", "not-found"),
        ("GET", "/redoc", "not-found"),
        ("GET", "/openapi.json", "not-found"),
        ("GET", "/api/v1/nothing", "not-found"),
        ("GET", "/api/v1/jobs/", "not-found"),
        ("GET", "/api/v1/jobs/none", "not-found"),
        ("GET", "/api/v1/jobs/none/events", "not-found"),
        ("POST", "/api/v1/jobs/none/cancel", "not-found"),
        ("POST", "/api/v1/jobs/none/pause", "not-found"),
        ("POST", "/api/v1/jobs/none/resume", "not-found"),
        ("POST", "/api/v1/tables/1/approve", "not-found"),
        ("POST", "/api/v1/tables/1/publish", "media-type"),
        ("GET", "/api/v1/lenses/1/tables", "not-found"),
        ("GET", "/api/v1/tables/1", "not-found"),
        ("PUT", "/api/v1/jobs", "method-not-allowed"),
        ("DELETE", "/api/v1/jobs/none", "method-not-allowed"),
        ("GET", "/api/v1/jobs/none/cancel", "method-not-allowed"),
        ("GET", "/api/v1/jobs?limit=0", "invalid"),
        ("GET", "/api/v1/jobs?limit=1e3", "invalid"),
        ("GET", "/api/v1/jobs?cursor=-1", "invalid"),
        ("GET", "/api/v1/jobs?cursor=9999999999999999999", "invalid"),
        ("GET", "/api/v1/jobs/none/events?after=-1", "invalid"),
        ("GET", "/api/v1/jobs/none/events?after=99999999999999999999999", "invalid"),
        ("GET", "/api/v1/tables/0", "invalid"),
        ("GET", "/api/v1/tables/99999999999999999999999", "invalid"),
        ("GET", "/api/v1/lenses/one/tables", "invalid"),
    ],
)
async def test_every_refusal_is_a_problem(client: httpx.AsyncClient, method: str, path: str, name: str) -> None:
    answer = await client.request(method, path)
    problem = assert_problem(answer, name)
    assert problem["instance"] == path.partition("?")[0]
    if name == "method-not-allowed":
        assert answer.headers["allow"]
    if name == "invalid":
        assert problem["errors"][0]["field"]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"lens": ""}, "body.lens"),
        ({"lenz": "XA"}, "body.lenz"),
        ({"levels": []}, "body"),
        ({"plan": {}}, "body"),
        ({"levels": [], "plan": {"max_levels": 1}}, "body.plan.max_levels"),
        ({"levels": [], "plan": {"zoom_range": [0.5, 0.5]}}, "body.plan"),
        ({"levels": [{"zoom": 2.0, "focus": 0.0}]}, "body.levels.0.zoom"),
        ({"levels": [{"zoom": 0.0, "focus": 0.0}] * 2}, "body"),
        ({"targets": {"board": {"kind": "circle"}}}, "body.targets.board.kind"),
        ({"goal_px": -1}, "body.goal_px"),
        ({"pivot_m": [0, 0]}, "body.pivot_m.2"),
    ],
)
async def test_a_wrong_job_names_its_field(client: httpx.AsyncClient, change: dict[str, Any], field: str) -> None:
    problem = assert_problem(await client.post("/api/v1/jobs", json={**JOB, **change}), "invalid")
    assert field in [error["field"] for error in problem["errors"]]
    assert problem["detail"].startswith(problem["errors"][0]["field"])


@pytest.mark.parametrize(
    "body", [b"", b"{", b"[]", b"null", b'"job"', b"\xff\xfe", b"[" * 15_000, b'{"lens": NaN}', b'{"goal_px": 1e999}']
)
async def test_a_body_that_is_no_job(client: httpx.AsyncClient, body: bytes) -> None:
    answer = await client.post("/api/v1/jobs", content=body, headers={"Content-Type": "application/json"})
    assert_problem(answer, "bad-request" if answer.status_code == 400 else "invalid")


@pytest.mark.parametrize(
    "kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data; boundary=x", ""]
)
async def test_only_json_is_taken_as_a_job(client: httpx.AsyncClient, ledger: Repository, kind: str) -> None:
    headers = {"Content-Type": kind} if kind else {}
    answer = await client.post("/api/v1/jobs", content=json.dumps(JOB).encode(), headers=headers)
    assert_problem(answer, "media-type")
    assert (await ledger.list_jobs()).jobs == ()


async def test_a_body_too_large_is_not_read(client: httpx.AsyncClient) -> None:
    asked = 0

    async def endless() -> AsyncIterator[bytes]:
        nonlocal asked
        for _ in range(1000):
            asked += 1
            yield b" " * 1000

    headers = {"Content-Type": "application/json"}
    for path in ("/api/v1/jobs", "/api/v1/nothing"):
        told = await client.post(path, content=b" " * 20_001, headers=headers)
        assert_problem(told, "body-too-large")
    assert_problem(await client.post("/api/v1/jobs", content=endless(), headers=headers), "body-too-large")
    assert asked <= 25


@pytest.mark.parametrize("length", ["-1", "x", "1e3", "9" * 30])
async def test_a_length_that_is_none(client: httpx.AsyncClient, length: str) -> None:
    answer = await client.post("/api/v1/jobs", content=b"{}", headers={"Content-Length": length})
    assert_problem(answer, "bad-request")


async def test_no_such_engine_and_no_more_room(client: httpx.AsyncClient, context: AppContext) -> None:
    problem = assert_problem(await client.post("/api/v1/jobs", json={**JOB, "engine": "r4"}), "unknown-engine")
    assert "this service knows: default" in problem["detail"]
    assert isinstance(context.runner, KeepingRunner)
    context.runner.full = True
    answer = await client.post("/api/v1/jobs", json=JOB)
    assert_problem(answer, "queue-full")
    assert answer.headers["retry-after"] == "7"


@pytest.mark.parametrize(
    ("error", "name", "retry"),
    [
        (StorageBusy("x.db", 5.0), "storage-busy", True),
        (StorageFull("x.db"), "storage-full", True),
        (DatabaseUnusable("x.db", "is damaged", "put back a backup copy"), "storage-unusable", False),
        (BadDocument("levels[0]", "is not whole", "export it again"), "stored-document-damaged", False),
    ],
)
async def test_trouble_with_the_store_is_told(
    client: httpx.AsyncClient,
    ledger: Repository,
    monkeypatch: pytest.MonkeyPatch,
    error: Exception,
    name: str,
    retry: bool,
) -> None:
    async def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(Repository, "get_job", fail)
    answer = await client.get("/api/v1/jobs/any")
    assert assert_problem(answer, name)["detail"] == str(error)
    assert ("retry-after" in answer.headers) is retry


async def test_a_mistake_of_ours_tells_nothing_of_itself(
    client: httpx.AsyncClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fail(*_: object) -> None:
        raise RuntimeError("the secret")

    monkeypatch.setattr(Repository, "get_job", fail)
    answer = await client.get("/api/v1/jobs/any")
    assert_problem(answer, "internal")
    assert "secret" not in answer.text


async def test_trouble_is_logged_once(
    client: httpx.AsyncClient, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def fail(*_: object) -> None:
        raise StorageFull("x.db")

    monkeypatch.setattr(Repository, "get_job", fail)
    with caplog.at_level(logging.ERROR):
        await client.get("/api/v1/jobs/any")
    assert [record.getMessage() for record in caplog.records if "x.db" in record.getMessage()] == [
        f"GET /api/v1/jobs/any: {StorageFull('x.db')}"
    ]


HOSTILE = [
    *("..", "%2e%2e", "%00", "%2f..%2f", "null", "'; DROP TABLE jobs; --", "<script>alert(1)</script>", "0" * 5000),
    *("\u202e", "%ff%fe", "-1", "1e999", "NaN", "[]", "{}", "C:\\x", "CON", "\\\\host\\share", "%0d%0aX: y"),
]


async def test_no_path_or_query_makes_the_service_fail(
    client: httpx.AsyncClient, ledger: Repository, context: AppContext
) -> None:
    await stored_job(ledger)
    for path, methods in create_app(context).openapi()["paths"].items():
        queries = [one["name"] for one in methods.get("get", {}).get("parameters", ()) if one["in"] == "query"]
        for text in HOSTILE:
            asked = path
            for name in ("job_id", "zoom", "focus", "lens_id", "table_id"):
                asked = asked.replace("{" + name + "}", text)
            for method in methods:
                answer = await client.request(method, asked, params=dict.fromkeys(queries, text))
                assert answer.status_code < 500, f"{method} {asked}: {answer.text}"
                if answer.status_code >= 400:
                    assert answer.headers["content-type"] == "application/problem+json"
                assert "x" not in answer.headers
