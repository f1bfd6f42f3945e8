"""Jobs of several kinds through the service's routes, over a real ledger."""

from __future__ import annotations

from typing import Any

import httpx
import pytest

from app.events import JobQueued, draft
from storage.repository import Repository
from tests.support.service import JOB, assert_problem, lens_table, stored_job


async def test_a_stored_table_is_published_by_a_job_of_its_own(client: httpx.AsyncClient, ledger: Repository) -> None:
    table = await ledger.save_table(None, lens_table())
    body = {"zoom": 0.0, "focus": 0.0, "targets": JOB["targets"], "pivot_m": JOB["pivot_m"]}
    answer = await client.post(f"/api/v1/tables/{table.id}/publish", json=body)
    assert answer.status_code == 201, answer.text
    job = answer.json()
    assert answer.headers["location"] == f"/api/v1/jobs/{job['id']}"
    assert (job["kind"], job["lens"], job["engine"], job["levels"]) == ("publish", "XA 20x", "default", 0)
    found = (await client.get(answer.headers["location"])).json()
    assert found["request"]["table_id"] == table.id
    assert found["request"]["targets"].keys() == JOB["targets"].keys()
    same = await client.post("/api/v1/jobs", json={**body, "kind": "publish", "table_id": table.id})
    assert same.status_code == 201
    assert (await client.get(same.headers["location"])).json()["request"] == found["request"]


async def test_jobs_of_all_kinds_are_listed_cancelled_and_watched_alike(
    client: httpx.AsyncClient, ledger: Repository
) -> None:
    made = await stored_job(ledger)
    table = await ledger.table_of_job(made.id)
    assert table is not None
    await client.post("/api/v1/jobs", json=JOB)
    publish = (await client.post(f"/api/v1/tables/{table.id}/publish", json={"all_levels": True})).json()
    listed = (await client.get("/api/v1/jobs")).json()["jobs"]
    assert [job["kind"] for job in listed] == ["publish", "calibrate", "calibrate"]
    assert [job["levels"] for job in listed] == [0, 2, 2], "a publication measures none"
    (event,) = (await client.get(f"/api/v1/jobs/{publish['id']}/events")).json()["events"]
    assert (event["kind"], event["job"], event["method"]) == ("job_queued", "publish", None)
    assert event["levels"] == 1, "one of the table's two levels has a lens"
    cancelled = await client.post(f"/api/v1/jobs/{publish['id']}/cancel")
    assert (cancelled.status_code, cancelled.json()["state"]) == (202, "cancelled")


async def test_a_job_stored_before_there_were_kinds_is_shown_as_a_calibration(
    client: httpx.AsyncClient, ledger: Repository
) -> None:
    old = {name: value for name, value in JOB.items() if name != "kind"}
    queued = JobQueued(lens="XA 20x", camera="Cam0", engine="default", method="joint", levels=2)
    kind, data = draft(queued)
    earlier = {name: value for name, value in data.items() if name != "job"}
    job = await ledger.create_job(old, "XA 20x", "default", None, (kind, earlier))
    assert (await client.get(f"/api/v1/jobs/{job.id}")).json()["kind"] == "calibrate"
    (event,) = (await client.get(f"/api/v1/jobs/{job.id}/events")).json()["events"]
    assert event["kind"] == "job_queued"


async def test_one_key_makes_one_publication(client: httpx.AsyncClient, ledger: Repository) -> None:
    path = f"/api/v1/tables/{(await ledger.save_table(None, lens_table())).id}/publish"
    headers = {"Idempotency-Key": "abc"}
    first, again = [(await client.post(path, json={}, headers=headers)).json()["id"] for _ in range(2)]
    assert first == again
    assert_problem(await client.post(path, json={"all_levels": True}, headers=headers), "idempotency-conflict")
    assert_problem(await client.post("/api/v1/jobs", json=JOB, headers=headers), "idempotency-conflict")


@pytest.mark.parametrize(
    ("path", "body", "name", "told"),
    [
        ("tables/{id}/publish", {"zoom": 0.5}, "invalid", "zoom and focus are given together"),
        ("tables/{id}/publish", {"zoom": 2, "focus": 0}, "invalid", "body.zoom"),
        ("tables/{id}/publish", {"table_id": 7}, "invalid", "body.table_id"),
        ("tables/{id}/publish", [], "invalid", "body"),
        ("tables/{id}/publish", {"engine": "studio 2"}, "unknown-engine", "studio 2"),
        ("tables/99/publish", {}, "not-found", "99"),
        ("tables/0/publish", {}, "invalid", "path.table_id"),
        ("jobs", {"kind": "publish", "table_id": 99}, "not-found", "99"),
        ("jobs", {"kind": "publish"}, "invalid", "either table_id or table"),
        ("jobs", {"kind": "recalibrate"}, "invalid", "there are calibrate, publish"),
        ("jobs", {"kind": "publish", "table_id": 1, "limit_px": -1}, "invalid", "body.limit_px"),
        ("jobs", {**JOB, "kind": "publish"}, "invalid", "body.lens"),
        ("jobs", [JOB], "invalid", "a job is a JSON object"),
    ],
)
async def test_what_cannot_be_published_is_a_problem(
    client: httpx.AsyncClient, ledger: Repository, path: str, body: Any, name: str, told: str
) -> None:
    table = await ledger.save_table(None, lens_table())
    problem = assert_problem(await client.post("/api/v1/" + path.format(id=table.id), json=body), name)
    assert told in problem["detail"]
    assert (await client.get("/api/v1/jobs")).json()["jobs"] == []


async def test_a_form_of_a_foreign_page_publishes_nothing(client: httpx.AsyncClient, ledger: Repository) -> None:
    path = f"/api/v1/tables/{(await ledger.save_table(None, lens_table())).id}/publish"
    assert_problem(await client.post(path, content="{}", headers={"Content-Type": "text/plain"}), "media-type")
    headers = {"Origin": "https://elsewhere.example"}
    assert_problem(await client.post(path, json={}, headers=headers), "origin-refused")
