"""The service's routes, over a real ledger and a runner that only keeps it: answers, refusals, and their documents."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
from collections.abc import AsyncIterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import jsonschema  # type: ignore[import-untyped]
import pytest

from app.api import errors, sockets
from app.api.context import AppContext
from app.documents import JobRequest
from app.engines import EngineInfo, UnknownEngine
from app.errors import QueueFull
from app.events import EVENTS, EventBroker, JobCancelled, JobQueued, JobStarted, LevelDone, draft
from app.main import create_app
from app.reference import pages
from app.settings import Settings
from calibration.lens import Lens
from calibration.tables import EVIDENCE_QUANTITIES, LensTable, LevelResult, PixelError
from storage.errors import BadDocument, DatabaseUnusable, StorageBusy, StorageFull
from storage.exports import EXPORTS
from storage.records import JobRecord, JobState, PictureKind
from storage.repository import Repository

SIZE = (1920, 1080)
JOB: dict[str, Any] = {
    "lens": "XA 20x",
    "levels": [{"zoom": 0.0, "focus": 0.0}, {"zoom": 1.0, "focus": 0.5}],
    "targets": {
        "board": {"kind": "chessboard", "squares": [8, 8], "square_m": 0.075, "pose": {"centre_m": [0.0, 6.0, 1.5]}}
    },
    "pivot_m": [0.0, 0.0, 1.5],
}
JPEG = b"\xff\xd8\xff\xe0 a picture"


class Clock:
    """A clock that is a second later at each look."""

    def __init__(self) -> None:
        self.moment = datetime(2026, 11, 21, 10, tzinfo=UTC)

    def __call__(self) -> datetime:
        self.moment += timedelta(seconds=1)
        return self.moment


class KeepingRunner:
    """Stores what it is asked to run, and runs nothing."""

    def __init__(self, repository: Repository, broker: EventBroker) -> None:
        self._repository = repository
        self._broker = broker
        self.full = False

    async def submit(self, request: JobRequest, *, idempotency_key: str | None = None) -> JobRecord:
        if request.engine != "default":
            raise UnknownEngine(f"no engine is called {request.engine!r}; this service knows: default")
        if self.full:
            raise QueueFull(3, retry_after_s=7)
        queued = JobQueued(
            lens=request.lens,
            camera=request.camera,
            engine=request.engine,
            method=request.method,
            levels=len(request.levels),
        )
        body = request.model_dump(mode="json")
        return await self._repository.create_job(body, request.lens, request.engine, idempotency_key, draft(queued))

    async def cancel(self, job_id: str) -> JobRecord:
        job = await self._repository.get_job(job_id)
        if job.state is not JobState.QUEUED:
            return job
        cancelled = draft(JobCancelled())
        return await self._repository.set_job_state(
            job_id, JobState.CANCELLED, expected=[JobState.QUEUED], event=cancelled
        )

    def engines(self) -> list[EngineInfo]:
        return [EngineInfo("default", "r3 127.0.0.1:9009", None, None), EngineInfo("b", "r3 b:9009", "a-job", "gone")]


@pytest.fixture(scope="module")
def empty_database(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A database file without rows: making its schema anew for each test would take most of the time."""
    path = tmp_path_factory.mktemp("empty") / "lensmatch.db"

    async def make() -> None:
        await (await Repository.open(path, Clock())).close()

    asyncio.run(make())
    return path.read_bytes()


@pytest.fixture
async def repository(tmp_path: Path, empty_database: bytes) -> AsyncIterator[Repository]:
    path = tmp_path / "lensmatch.db"
    path.write_bytes(empty_database)
    async with await Repository.open(path, Clock()) as opened:
        yield opened


@pytest.fixture
def root() -> Path:
    return Path(__file__).resolve().parents[2]


@pytest.fixture
def context(repository: Repository, tmp_path: Path) -> AppContext:
    settings = Settings(
        database=tmp_path / "lensmatch.db",
        max_body_bytes=20_000,
        allowed_origins=("https://studio.example",),
        min_free_disk_bytes=0,
    )
    broker = EventBroker()
    return AppContext(settings, repository, KeepingRunner(repository, broker), broker, Clock())


@pytest.fixture
async def client(context: AppContext) -> AsyncIterator[httpx.AsyncClient]:
    transport = httpx.ASGITransport(create_app(context), raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:8000") as opened:
        yield opened


def level(zoom: float = 0.0, focus: float = 0.0) -> LevelResult:
    told: dict[str, Any] = {name: PixelError(0.1, 0.3) for name in EVIDENCE_QUANTITIES if name != "held_out_px"}
    lens = Lens.from_fov(SIZE, 56.1, -0.12, 0.031, (4.31, -2.7))
    reasons = {"nodal_offset_mm": "one distance only", "held_out_px": "too few pictures"}
    return LevelResult.from_lens(zoom, focus, lens, reasons=reasons, **told)


def table(lens: str = "XA 20x") -> LensTable:
    created = datetime(2026, 11, 21, 10, tzinfo=UTC)
    return LensTable(lens, "Cam0", 1, created, SIZE, "joint", (level(), LevelResult.failed(1.0, 0.5, "no board")))


async def stored_job(repository: Repository) -> JobRecord:
    """A job with one level done, one failed, a picture and its table."""
    job = await repository.create_job(JOB, "XA 20x", "default")
    running = draft(JobStarted(engine="default", levels=2))
    await repository.set_job_state(job.id, JobState.RUNNING, expected=[JobState.QUEUED], event=running)
    await repository.save_level(job.id, 0, level(), draft(LevelDone.of(0, level())))
    await repository.save_level(job.id, 1, LevelResult.failed(1.0, 0.5, "no board"), ("level_failed", {}))
    await repository.save_picture(job.id, 0, PictureKind.OVERLAY, "image/jpeg", JPEG)
    await repository.save_picture(job.id, 0, PictureKind.REAL, "image/svg+xml", b"<svg onload='alert(1)'/>")
    await repository.save_table(job.id, table())
    return await repository.get_job(job.id)


def assert_problem(answer: httpx.Response, name: str) -> dict[str, Any]:
    assert answer.headers["content-type"] == "application/problem+json", answer.text
    problem: dict[str, Any] = answer.json()
    assert problem["type"] == f"urn:lensmatch:problem:{name}", problem
    assert problem["status"] == answer.status_code == errors.PROBLEMS[name].status
    assert problem["title"] == errors.PROBLEMS[name].title
    assert problem["detail"]
    assert "\n" not in problem["detail"]
    assert "Traceback" not in answer.text
    assert answer.headers["x-content-type-options"] == "nosniff"
    return problem


# Jobs


async def test_a_job_is_stored_before_it_is_acknowledged(client: httpx.AsyncClient, repository: Repository) -> None:
    answer = await client.post("/api/v1/jobs", json=JOB)
    assert answer.status_code == 201
    job = answer.json()
    assert answer.headers["location"] == f"/api/v1/jobs/{job['id']}"
    assert (job["state"], job["lens"], job["levels"], job["last_seq"]) == ("queued", "XA 20x", 2, 1)
    assert (await repository.get_job(job["id"])).request["levels"] == JOB["levels"]
    found = (await client.get(answer.headers["location"])).json()
    assert {name: found[name] for name in job} == job
    assert (found["results"], found["table_id"]) == ([], None)
    assert found["request"]["goal_px"] == 0.03


async def test_one_key_makes_one_job(client: httpx.AsyncClient) -> None:
    async def post() -> httpx.Response:
        return await client.post("/api/v1/jobs", json=JOB, headers={"Idempotency-Key": "abc"})

    answers = await asyncio.gather(*(post() for _ in range(20)))
    assert {answer.status_code for answer in answers} == {201}
    assert len({answer.json()["id"] for answer in answers}) == 1
    assert len((await client.get("/api/v1/jobs")).json()["jobs"]) == 1
    other = await client.post("/api/v1/jobs", json={**JOB, "lens": "other"}, headers={"Idempotency-Key": "abc"})
    assert_problem(other, "idempotency-conflict")


@pytest.mark.parametrize("key", ["", "two words", "x" * 201, "\u00e9"])
async def test_a_key_that_is_none_is_refused(client: httpx.AsyncClient, key: str) -> None:
    headers = {b"Idempotency-Key": key.encode("latin-1")}
    answer = await client.post("/api/v1/jobs", json=JOB, headers=headers)
    problem = assert_problem(answer, "invalid")
    assert problem["errors"][0]["field"] == "header.idempotency-key"


async def test_jobs_come_in_pages_newest_first(client: httpx.AsyncClient) -> None:
    made = [(await client.post("/api/v1/jobs", json=JOB)).json()["id"] for _ in range(5)]
    seen, cursor = [], None
    while True:
        query = {"limit": 2} | ({"cursor": cursor} if cursor else {})
        page = (await client.get("/api/v1/jobs", params=query)).json()
        assert len(page["jobs"]) <= 2
        seen += [job["id"] for job in page["jobs"]]
        cursor = page["next_cursor"]
        if cursor is None:
            break
    assert seen == made[::-1]


async def test_a_job_tells_its_levels_and_its_table(client: httpx.AsyncClient, repository: Repository) -> None:
    job = await stored_job(repository)
    found = (await client.get(f"/api/v1/jobs/{job.id}")).json()
    done, failed = found["results"]
    assert (done["ordinal"], done["result"]["status"], done["result"]["k1"]) == (0, "ok", -0.12)
    assert (failed["result"]["status"], failed["result"]["reason"], failed["result"]["k1"]) == (
        "failed",
        "no board",
        None,
    )
    assert found["table_id"] == 1


async def test_cancelling_twice_is_as_good_as_once(client: httpx.AsyncClient) -> None:
    job = (await client.post("/api/v1/jobs", json=JOB)).json()
    for _ in range(2):
        answer = await client.post(f"/api/v1/jobs/{job['id']}/cancel")
        assert (answer.status_code, answer.json()["state"]) == (202, "cancelled")


async def test_events_as_a_list_go_on_where_they_stopped(client: httpx.AsyncClient, repository: Repository) -> None:
    job = await stored_job(repository)
    path = f"/api/v1/jobs/{job.id}/events"
    first = (await client.get(path, params={"limit": 2})).json()
    assert [event["kind"] for event in first["events"]] == ["job_started", "level_done"]
    assert (first["last_seq"], first["more"]) == (2, True)
    rest = (await client.get(path, params={"after": first["last_seq"]})).json()
    assert ([event["seq"] for event in rest["events"]], rest["last_seq"], rest["more"]) == ([3], 3, False)
    none = (await client.get(path, params={"after": 3})).json()
    assert (none["events"], none["last_seq"], none["more"]) == ([], 3, False)


async def test_events_are_what_their_schema_says(client: httpx.AsyncClient, repository: Repository, root: Path) -> None:
    job = await stored_job(repository)
    schema = json.loads((root / "docs" / "reference" / "events.schema.json").read_text("utf-8"))
    for event in (await client.get(f"/api/v1/jobs/{job.id}/events", params={"limit": 2})).json()["events"]:
        jsonschema.validate(event, schema)
        EVENTS.validate_python(event)


# Pictures


async def test_a_picture_of_a_level(client: httpx.AsyncClient, repository: Repository) -> None:
    path = f"/api/v1/jobs/{(await stored_job(repository)).id}/levels/0/0.0/picture"
    answer = await client.get(path, params={"kind": "overlay"})
    assert (answer.content, answer.headers["content-type"]) == (JPEG, "image/jpeg")
    again = await client.get(path, headers={"If-None-Match": f'"other", {answer.headers["etag"]}'})
    assert (again.status_code, again.content) == (304, b"")


async def test_only_pictures_are_shown_as_pictures(client: httpx.AsyncClient, repository: Repository) -> None:
    path = f"/api/v1/jobs/{(await stored_job(repository)).id}/levels/0/0/picture"
    answer = await client.get(path, params={"kind": "real"})
    assert answer.headers["content-type"] == "application/octet-stream"
    assert answer.headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize(
    ("place", "name"),
    [
        ("0/0/picture?kind=virtual", "not-found"),
        ("0.5/0/picture", "not-found"),
        ("0/0/picture?kind=secret", "invalid"),
        ("nan/0/picture", "invalid"),
        ("1e999/0/picture", "invalid"),
        ("-0.1/0/picture", "invalid"),
    ],
)
async def test_pictures_that_are_not_there(
    client: httpx.AsyncClient, repository: Repository, place: str, name: str
) -> None:
    job = await stored_job(repository)
    assert_problem(await client.get(f"/api/v1/jobs/{job.id}/levels/{place}"), name)


# Lenses and tables


async def test_lenses_lead_to_tables(client: httpx.AsyncClient, repository: Repository) -> None:
    job = await stored_job(repository)
    (lens,) = (await client.get("/api/v1/lenses")).json()["lenses"]
    assert (lens["lens"], lens["camera"], lens["latest_version"]) == ("XA 20x", "Cam0", 1)
    (found,) = (await client.get(f"/api/v1/lenses/{lens['id']}/tables")).json()["tables"]
    assert (found["job_id"], found["version"]) == (job.id, 1)
    answer = await client.get(f"/api/v1/tables/{found['id']}")
    assert hashlib.sha256(answer.content).hexdigest() == found["sha256"]
    assert answer.headers["etag"] == f'"{found["sha256"]}"'
    assert "content-disposition" not in answer.headers
    assert answer.json()["levels"][1]["reason"] == "no board"


@pytest.mark.parametrize("name", EXPORTS)
async def test_a_table_in_every_format(client: httpx.AsyncClient, repository: Repository, name: str) -> None:
    await stored_job(repository)
    answer = await client.get("/api/v1/tables/1", params={"format": name})
    assert answer.headers["content-type"].partition(";")[0] == EXPORTS[name].media_type
    assert EXPORTS[name].read(answer.content) == (await repository.get_table(1)).table
    assert f'filename="XA_20x_Cam0_v1{EXPORTS[name].suffix}"' in answer.headers["content-disposition"]
    again = await client.get(
        "/api/v1/tables/1", params={"format": name}, headers={"If-None-Match": answer.headers["etag"]}
    )
    assert (again.status_code, again.content) == (304, b"")


async def test_formats_have_tags_of_their_own(client: httpx.AsyncClient, repository: Repository) -> None:
    await stored_job(repository)
    tags = {(await client.get("/api/v1/tables/1", params={"format": name})).headers["etag"] for name in EXPORTS}
    assert len(tags) == len(EXPORTS)


async def test_the_name_of_a_lens_cannot_leave_its_header(client: httpx.AsyncClient, repository: Repository) -> None:
    await repository.save_table(None, table('../"Zoom" ; x=\u00e9'))
    header = (await client.get("/api/v1/tables/1", params={"format": "csv"})).headers["content-disposition"]
    assert header.isascii()
    assert header.startswith("attachment; filename=\"Zoom_x_Cam0_v1.csv\"; filename*=UTF-8''")
    assert "/" not in header.partition("; ")[2]


async def test_a_format_that_does_not_exist_names_those_that_do(
    client: httpx.AsyncClient, repository: Repository
) -> None:
    await stored_job(repository)
    problem = assert_problem(await client.get("/api/v1/tables/1", params={"format": "docx"}), "invalid")
    assert problem["errors"] == [{"field": "query.format", "message": "there is no format 'docx'; there are json, csv"}]


# The service


async def test_engines_tell_who_has_them(client: httpx.AsyncClient) -> None:
    free, dirty = (await client.get("/api/v1/engines")).json()["engines"]
    assert free == {"name": "default", "address": "r3 127.0.0.1:9009", "job_id": None, "dirty": None}
    assert (dirty["job_id"], dirty["dirty"]) == ("a-job", "gone")


async def test_alive_and_ready(client: httpx.AsyncClient) -> None:
    assert (await client.get("/api/v1/healthz")).json() == {"status": "alive"}
    ready = (await client.get("/api/v1/readyz")).json()
    assert (ready["status"], [check["name"] for check in ready["checks"]]) == ("ready", ["database", "disk"])


async def test_not_ready_without_room_on_the_disk(context: AppContext) -> None:
    short = AppContext(
        context.settings.model_copy(update={"min_free_disk_bytes": 2**62}),
        context.repository,
        context.runner,
        context.broker,
        context.now,
    )
    transport = httpx.ASGITransport(create_app(short))
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        problem = assert_problem(await client.get("/api/v1/readyz"), "not-ready")
        assert "MiB free" in problem["detail"]
        assert (await client.get("/api/v1/healthz")).status_code == 200


async def test_not_ready_without_the_database(client: httpx.AsyncClient, repository: Repository) -> None:
    await repository.close()
    assert_problem(await client.get("/api/v1/readyz"), "storage-unusable")
    assert (await client.get("/api/v1/healthz")).status_code == 200


# Refusals


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
        ("POST", "/api/v1/tables/1/publish", "not-found"),
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
        ({"levels": []}, "body.levels"),
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
async def test_only_json_is_taken_as_a_job(client: httpx.AsyncClient, repository: Repository, kind: str) -> None:
    headers = {"Content-Type": kind} if kind else {}
    answer = await client.post("/api/v1/jobs", content=json.dumps(JOB).encode(), headers=headers)
    assert_problem(answer, "media-type")
    assert (await repository.list_jobs()).jobs == ()


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
    repository: Repository,
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
    client: httpx.AsyncClient, repository: Repository, context: AppContext
) -> None:
    await stored_job(repository)
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


# Foreign pages

FOREIGN_HOSTS = [
    *("evil.example", "127.0.0.1.evil.example", "evil.example:8000", "localhost.evil.example", "localhost.", "", " "),
    *("127.0.0.1@evil.example", "127.0.0.1/", "127.0.0.1:8000:8000", "127.0.0.1:port", "[::1", "::1", "[::2]"),
    *("0.0.0.0", "127.0.0.2", "127.1", "2130706433", "localhost\t", "localhost,evil.example", "xn--localhost-", "*"),
]


async def test_foreign_names_are_refused(client: httpx.AsyncClient) -> None:
    for host in FOREIGN_HOSTS:
        assert_problem(await client.get("/api/v1/healthz", headers={"Host": host}), "host-refused")


async def test_own_names_are_answered(client: httpx.AsyncClient) -> None:
    for host in ("localhost", "LOCALHOST:1234", "127.0.0.1", "[::1]:8000"):
        assert (await client.get("/api/v1/healthz", headers={"Host": host})).status_code == 200, host


async def test_two_names_are_refused(client: httpx.AsyncClient) -> None:
    two = [("Host", "127.0.0.1"), ("Host", "127.0.0.1")]
    assert_problem(await client.get("/api/v1/healthz", headers=two), "host-refused")


FOREIGN_PAGES: list[dict[str, str]] = [
    *(
        {"Origin": origin}
        for origin in (
            *(
                "https://evil.example",
                "http://127.0.0.1",
                "https://127.0.0.1:8000",
                "http://127.0.0.1:8001",
                "null",
                "",
            ),
            *("http://localhost:8000", "http://127.0.0.1:8000.evil.example", "http://127.0.0.1:8000/", "file://"),
            *("https://studio.example.evil.example", "http://studio.example", "https://studio.example:1"),
        )
    ),
    {"Sec-Fetch-Site": "cross-site"},
    {"Sec-Fetch-Site": "same-site"},
]


@pytest.mark.parametrize("headers", FOREIGN_PAGES, ids=str)
async def test_foreign_pages_change_nothing(
    client: httpx.AsyncClient, repository: Repository, headers: dict[str, str]
) -> None:
    body = json.dumps(JOB).encode()
    for method in ("POST", "PUT", "PATCH", "DELETE"):
        for kind in ("application/json", "text/plain", "multipart/form-data; boundary=x", "text/html", ""):
            sent = {**headers, "Content-Type": kind}
            assert_problem(await client.request(method, "/api/v1/jobs", content=body, headers=sent), "origin-refused")
    assert (await repository.list_jobs()).jobs == ()


@pytest.mark.parametrize("origin", ["http://127.0.0.1:8000", "https://studio.example", "HTTPS://STUDIO.EXAMPLE"])
async def test_own_pages_may(client: httpx.AsyncClient, origin: str) -> None:
    assert (await client.post("/api/v1/jobs", json=JOB, headers={"Origin": origin})).status_code == 201


async def test_two_origins_are_refused(client: httpx.AsyncClient) -> None:
    two = [("Origin", "http://127.0.0.1:8000"), ("Origin", "http://127.0.0.1:8000")]
    assert_problem(await client.post("/api/v1/jobs", json=JOB, headers=two), "origin-refused")


# The documents


@pytest.mark.parametrize("name", ["openapi.json", "events.schema.json", "settings.md"])
def test_the_reference_is_current(name: str, root: Path) -> None:
    written = (root / "docs" / "reference" / name).read_text("utf-8")
    assert written == pages()[name], "run: python -m app.reference docs/reference"


async def test_the_service_describes_itself(client: httpx.AsyncClient, root: Path) -> None:
    told = (await client.get("/api/v1/openapi.json")).json()
    assert told == json.loads((root / "docs" / "reference" / "openapi.json").read_text("utf-8"))
    assert "ProblemDocument" in told["components"]["schemas"]


def test_every_route_problem_and_close_code_is_documented(root: Path, context: AppContext) -> None:
    page = (root / "docs" / "reference" / "rest.md").read_text("utf-8")
    for path, methods in create_app(context).openapi()["paths"].items():
        for method in methods:
            told = f"`{method.upper()} {path.removeprefix('/api/v1')}"
            assert f"{told}`" in page or f"{told}?" in page, told
    for name, kind in errors.PROBLEMS.items():
        assert f"| `{name}` | {kind.status} |" in page, name
    for code in sockets.CLOSE_CODES:
        assert f"| {code} |" in page, code


def test_every_event_and_field_is_documented(root: Path) -> None:
    page = (root / "docs" / "reference" / "events.md").read_text("utf-8")
    schema = json.loads((root / "docs" / "reference" / "events.schema.json").read_text("utf-8"))
    rows = {line.split("|")[1].strip(" `"): line for line in page.splitlines() if line.startswith("| `")}
    for kind, place in schema["discriminator"]["mapping"].items():
        row = rows[kind]
        common = {"seq", "at", "kind", "job_id", "number", "ordinal", "zoom", "focus"}
        for field in set(schema["$defs"][place.rpartition("/")[2]]["properties"]) - common:
            assert f"`{field}`" in row, f"{kind}: {field}"
