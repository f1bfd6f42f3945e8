"""The service's resources over a real ledger: jobs, events, pictures, lenses, tables, engines, and its health."""

from __future__ import annotations

import asyncio
import hashlib
import json
from dataclasses import replace
from pathlib import Path

import httpx
import jsonschema  # type: ignore[import-untyped]
import pytest

from app.api.context import AppContext
from app.events import EVENTS
from app.main import create_app
from calibration.tables import LevelResult
from storage.exports import EXPORTS
from storage.repository import Repository
from tests.support.service import JOB, JPEG, assert_problem, lens_table, stored_job

# Jobs


async def test_a_job_is_stored_before_it_is_acknowledged(client: httpx.AsyncClient, ledger: Repository) -> None:
    answer = await client.post("/api/v1/jobs", json=JOB)
    assert answer.status_code == 201
    job = answer.json()
    assert answer.headers["location"] == f"/api/v1/jobs/{job['id']}"
    assert (job["state"], job["lens"], job["levels"], job["last_seq"]) == ("queued", "XA 20x", 2, 1)
    assert (await ledger.get_job(job["id"])).request["levels"] == JOB["levels"]
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


async def test_a_job_tells_its_levels_and_its_table(client: httpx.AsyncClient, ledger: Repository) -> None:
    job = await stored_job(ledger)
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


async def test_events_as_a_list_go_on_where_they_stopped(client: httpx.AsyncClient, ledger: Repository) -> None:
    job = await stored_job(ledger)
    path = f"/api/v1/jobs/{job.id}/events"
    first = (await client.get(path, params={"limit": 2})).json()
    assert [event["kind"] for event in first["events"]] == ["job_started", "level_done"]
    assert (first["last_seq"], first["more"]) == (2, True)
    rest = (await client.get(path, params={"after": first["last_seq"]})).json()
    assert ([event["seq"] for event in rest["events"]], rest["last_seq"], rest["more"]) == ([3], 3, False)
    none = (await client.get(path, params={"after": 3})).json()
    assert (none["events"], none["last_seq"], none["more"]) == ([], 3, False)


async def test_events_are_what_their_schema_says(
    client: httpx.AsyncClient, ledger: Repository, repository: Path
) -> None:
    job = await stored_job(ledger)
    schema = json.loads((repository / "docs" / "reference" / "events.schema.json").read_text("utf-8"))
    for event in (await client.get(f"/api/v1/jobs/{job.id}/events", params={"limit": 2})).json()["events"]:
        jsonschema.validate(event, schema)
        EVENTS.validate_python(event)


# Pictures


async def test_a_picture_of_a_level(client: httpx.AsyncClient, ledger: Repository) -> None:
    path = f"/api/v1/jobs/{(await stored_job(ledger)).id}/levels/0/0.0/picture"
    answer = await client.get(path, params={"kind": "overlay"})
    assert (answer.content, answer.headers["content-type"]) == (JPEG, "image/jpeg")
    again = await client.get(path, headers={"If-None-Match": f'"other", {answer.headers["etag"]}'})
    assert (again.status_code, again.content) == (304, b"")


async def test_the_evidence_of_a_level(client: httpx.AsyncClient, ledger: Repository) -> None:
    job = await stored_job(ledger, evidence='{"level_evidence":1}')
    path = f"/api/v1/jobs/{job.id}/levels/0/0.0/evidence"
    answer = await client.get(path)
    assert (answer.status_code, answer.json()) == (200, {"level_evidence": 1})
    again = await client.get(path, headers={"If-None-Match": answer.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


async def test_only_pictures_are_shown_as_pictures(client: httpx.AsyncClient, ledger: Repository) -> None:
    path = f"/api/v1/jobs/{(await stored_job(ledger)).id}/levels/0/0/picture"
    answer = await client.get(path, params={"kind": "real"})
    assert answer.headers["content-type"] == "application/octet-stream"
    assert answer.headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize(
    ("place", "name"),
    [
        ("0/0/picture?kind=virtual", "not-found"),
        ("0.5/0/picture", "not-found"),
        ("0/0/picture?kind=secret", "invalid"),
        ("0/0/evidence", "not-found"),
        ("2/0/evidence", "invalid"),
        ("nan/0/picture", "invalid"),
        ("1e999/0/picture", "invalid"),
        ("-0.1/0/picture", "invalid"),
    ],
)
async def test_pictures_that_are_not_there(
    client: httpx.AsyncClient, ledger: Repository, place: str, name: str
) -> None:
    job = await stored_job(ledger)
    assert_problem(await client.get(f"/api/v1/jobs/{job.id}/levels/{place}"), name)


# Lenses and tables


async def test_lenses_lead_to_tables(client: httpx.AsyncClient, ledger: Repository) -> None:
    job = await stored_job(ledger)
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
async def test_a_table_in_every_format(client: httpx.AsyncClient, ledger: Repository, name: str) -> None:
    await stored_job(ledger)
    answer = await client.get("/api/v1/tables/1", params={"format": name})
    assert answer.headers["content-type"].partition(";")[0] == EXPORTS[name].media_type
    read, stored = EXPORTS[name].read(answer.content), (await ledger.get_table(1)).table
    if EXPORTS[name].cannot_carry:
        read, stored = (replace(table, levels=table.levels[:1]) for table in (read, stored))
        assert [level.fov_x_deg for level in read.levels] == pytest.approx([level.fov_x_deg for level in stored.levels])
    else:
        assert read == stored
    assert f'filename="XA_20x_Cam0_v1{EXPORTS[name].suffix}"' in answer.headers["content-disposition"]
    again = await client.get(
        "/api/v1/tables/1", params={"format": name}, headers={"If-None-Match": answer.headers["etag"]}
    )
    assert (again.status_code, again.content) == (304, b"")


async def test_formats_have_tags_of_their_own(client: httpx.AsyncClient, ledger: Repository) -> None:
    await stored_job(ledger)
    tags = {(await client.get("/api/v1/tables/1", params={"format": name})).headers["etag"] for name in EXPORTS}
    assert len(tags) == len(EXPORTS)


async def test_the_name_of_a_lens_cannot_leave_its_header(client: httpx.AsyncClient, ledger: Repository) -> None:
    await ledger.save_table(None, lens_table('../"Zoom" ; x=\u00e9'))
    header = (await client.get("/api/v1/tables/1", params={"format": "csv"})).headers["content-disposition"]
    assert header.isascii()
    assert header.startswith("attachment; filename=\"Zoom_x_Cam0_v1.csv\"; filename*=UTF-8''")
    assert "/" not in header.partition("; ")[2]


async def test_a_format_that_does_not_exist_names_those_that_do(client: httpx.AsyncClient, ledger: Repository) -> None:
    await stored_job(ledger)
    problem = assert_problem(await client.get("/api/v1/tables/1", params={"format": "docx"}), "invalid")
    told = f"there is no format 'docx'; there are {', '.join(EXPORTS)}"
    assert problem["errors"] == [{"field": "query.format", "message": told}]


async def test_a_format_that_cannot_carry_a_table_says_so(client: httpx.AsyncClient, ledger: Repository) -> None:
    failed = LevelResult.failed(0.0, 0.5, "no board")
    await ledger.save_table(None, replace(lens_table("XA 20x"), levels=(failed,)))
    problem = assert_problem(await client.get("/api/v1/tables/1", params={"format": "colmap"}), "invalid")
    assert problem["errors"][0]["field"] == "query.format"
    assert "no level of this table has a field of view" in problem["errors"][0]["message"]


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


async def test_not_ready_without_the_database(client: httpx.AsyncClient, ledger: Repository) -> None:
    await ledger.close()
    assert_problem(await client.get("/api/v1/readyz"), "storage-unusable")
    assert (await client.get("/api/v1/healthz")).status_code == 200
