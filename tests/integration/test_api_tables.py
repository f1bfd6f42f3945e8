"""Versions of lens tables over the service: import, approval, roll back, history, comparison, and what is refused."""

from __future__ import annotations

import hashlib
import json
from collections.abc import AsyncIterator
from dataclasses import replace
from typing import Any

import httpx
import pytest

from app.api.context import AppContext
from app.main import create_app
from calibration.tables import LensTable, Provenance
from storage.exports import EXPORTS
from storage.repository import Repository
from tests.support.service import assert_problem, lens_table, measured_level

JSON = {"Content-Type": "application/json"}


def document(**changes: Any) -> bytes:
    """A lens table file."""
    return EXPORTS["json"].write(replace(lens_table(), **changes))


async def send(client: httpx.AsyncClient, data: bytes, kind: str = "application/json", **query: Any) -> httpx.Response:
    return await client.post("/api/v1/tables", content=data, params=query, headers={"Content-Type": kind})


async def versions(client: httpx.AsyncClient, count: int) -> list[int]:
    """Ids of that many versions of one lens."""
    made = [await send(client, document(method=f"method {number}")) for number in range(count)]
    assert [answer.status_code for answer in made] == [201] * count
    return [answer.json()["id"] for answer in made]


async def approved(client: httpx.AsyncClient) -> list[int]:
    tables = (await client.get("/api/v1/lenses/1/tables")).json()["tables"]
    (lens,) = (await client.get("/api/v1/lenses")).json()["lenses"]
    ids = [table["id"] for table in tables if table["approved"]]
    assert ids == ([] if lens["approved_table_id"] is None else [lens["approved_table_id"]])
    return ids


# Import


async def test_a_file_becomes_the_next_version_with_its_provenance(
    client: httpx.AsyncClient, ledger: Repository
) -> None:
    made_by_a_job = replace(lens_table(), provenance=Provenance("calibrated", "lensmatch 0.0.9", job_id="j"))
    await ledger.save_table(None, lens_table())
    data = EXPORTS["json"].write(made_by_a_job)
    answer = await send(client, data, by="Anna", note="from the other stage")
    assert answer.status_code == 201
    view = answer.json()
    assert answer.headers["location"] == f"/api/v1/tables/{view['id']}" == "/api/v1/tables/2"
    assert (view["version"], view["job_id"], view["approved"]) == (2, None, False)
    told = view["provenance"]
    assert (told["source"], told["note"]) == ("imported", "read from a json file; calibrated by lensmatch 0.0.9, job j")
    assert told["inputs_sha256"] == told["parent_sha256"] == hashlib.sha256(data).hexdigest()
    stored = (await client.get(answer.headers["location"])).json()
    assert (stored["provenance"], stored["version"]) == (told, 2)
    assert stored["levels"] == json.loads(data)["levels"]
    (action,) = (await client.get("/api/v1/tables/2/history")).json()["actions"]
    assert (action["kind"], action["by"], action["note"]) == ("imported", "Anna", "from the other stage")


async def test_every_format_that_is_written_is_taken(client: httpx.AsyncClient) -> None:
    data = EXPORTS["csv"].write(lens_table())
    for kind in ("text/csv; charset=utf-8", "application/octet-stream"):
        answer = await send(client, data, kind, format="csv")
        assert answer.json()["provenance"]["note"] == "read from a csv file"
    assert len((await client.get("/api/v1/lenses/1/tables")).json()["tables"]) == 1


async def test_the_same_file_again_is_the_version_of_before(client: httpx.AsyncClient) -> None:
    first, again = await send(client, document()), await send(client, document())
    assert (first.status_code, again.status_code) == (201, 200)
    assert again.json() == first.json()
    assert again.headers["location"] == first.headers["location"]


async def test_a_file_may_be_stored_under_other_names(client: httpx.AsyncClient, ledger: Repository) -> None:
    assert (await send(client, document(), lens="Ünder 25x", camera="Cam 9")).status_code == 201
    (lens,) = await ledger.list_lenses()
    assert (lens.name, lens.camera) == ("Ünder 25x", "Cam 9")
    assert_problem(await send(client, document(), lens="a\nb"), "invalid")
    assert_problem(await send(client, document(), camera=" "), "invalid")


async def test_another_picture_is_refused_unless_asked_for(client: httpx.AsyncClient) -> None:
    await send(client, document(sensor_mm=(9.59, 5.39)))
    other = document(sensor_mm=(24.9, 14.0))
    problem = assert_problem(await send(client, other), "name-clash")
    assert "a sensor of 9.59 x 5.39 mm there, of 24.9 x 14 mm here" in problem["detail"]
    assert len((await client.get("/api/v1/lenses/1/tables")).json()["tables"]) == 1
    assert (await send(client, other, camera="Cam1")).json()["version"] == 1
    assert (await send(client, other, other_picture=True)).json()["version"] == 2


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"", "not JSON"),
        (b"{}", "lens_table"),
        (b"\xff\xfe", "UTF-8"),
        (b"[" * 50_000, "nested too deeply"),
        (document()[:-100], "not JSON"),
        (document().replace(b'"lens_table": 1', b'"lens_table": 2'), "version 2"),
        (document().replace(b"56.1", b"NaN"), "NaN"),
        (document().replace(b"56.1", b"1e999"), "fov_x_deg"),
        (document().replace(b'"zoom": 1.0', b'"zoom": 0.0').replace(b'"focus": 0.5', b'"focus": 0.0'), "twice"),
    ],
)
async def test_a_bad_file_is_one_line_and_nothing_is_stored(
    client: httpx.AsyncClient, ledger: Repository, data: bytes, told: str
) -> None:
    problem = assert_problem(await send(client, data), "invalid")
    assert told in problem["detail"]
    assert problem["errors"][0]["field"] == "body"
    assert await ledger.list_lenses() == []


async def test_only_files_of_the_format_are_taken(client: httpx.AsyncClient, ledger: Repository) -> None:
    for kind in ("text/plain", "multipart/form-data; boundary=x", "application/x-www-form-urlencoded", "text/csv", ""):
        problem = assert_problem(await send(client, document(), kind), "media-type")
        assert "send a json file as application/json or application/octet-stream" in problem["detail"]
    problem = assert_problem(await send(client, b"", format="docx"), "invalid")
    assert problem["errors"][0]["message"].startswith("there is no format 'docx'; there are json, csv")
    assert await ledger.list_lenses() == []


async def test_a_file_too_large_is_not_read(context: AppContext, ledger: Repository) -> None:
    asked = 0

    async def endless() -> AsyncIterator[bytes]:
        nonlocal asked
        for _ in range(1000):
            asked += 1
            yield b" " * 1000

    bounded = replace(context, settings=context.settings.model_copy(update={"max_table_bytes": 30_000}))
    transport = httpx.ASGITransport(create_app(bounded), raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        assert_problem(await client.post("/api/v1/tables", content=b" " * 30_001, headers=JSON), "body-too-large")
        assert_problem(await client.post("/api/v1/tables", content=endless(), headers=JSON), "body-too-large")
        # Larger than other bodies may be (20,000 bytes here), and still taken.
        padded = document() + b" " * 22_000
        assert (await client.post("/api/v1/tables", content=padded, headers=JSON)).status_code == 201
    assert asked <= 35


# Approval and roll back


async def test_one_table_of_a_lens_is_approved_and_the_one_before_can_come_back(client: httpx.AsyncClient) -> None:
    first, second, third = await versions(client, 3)
    assert await approved(client) == []
    answer = await client.post(f"/api/v1/tables/{first}/approve", json={"by": "Anna", "note": "seen on stage 2"})
    assert (answer.status_code, answer.json()["approved"]) == (200, True)
    await client.post(f"/api/v1/tables/{third}/approve")
    assert await approved(client) == [third]
    back = await client.post(f"/api/v1/tables/{third}/rollback", json={"by": "Ben"})
    assert (back.status_code, back.json()["id"], back.json()["approved"]) == (200, first, True)
    assert await approved(client) == [first]
    history = (await client.get(f"/api/v1/tables/{first}/history")).json()["actions"]
    assert [(one["kind"], one["table_id"], one["replaces_id"], one["by"]) for one in history] == [
        ("rolled_back", first, third, "Ben"),
        ("approved", third, first, None),
        ("approved", first, None, "Anna"),
        ("imported", first, None, None),
    ]
    assert [one["version"] for one in history] == [1, 3, 1, 1]
    assert [one["number"] for one in history] == sorted((one["number"] for one in history), reverse=True)
    assert all(one["at"].endswith("Z") for one in history)
    limited = (await client.get(f"/api/v1/tables/{first}/history", params={"limit": 1})).json()["actions"]
    assert limited == history[:1]
    assert (await client.get(f"/api/v1/tables/{second}/history")).json()["actions"][0]["kind"] == "imported"


async def test_approving_twice_is_as_good_as_once(client: httpx.AsyncClient) -> None:
    (table_id,) = await versions(client, 1)
    answers = [await client.post(f"/api/v1/tables/{table_id}/approve") for _ in range(2)]
    assert answers[0].json() == answers[1].json()
    assert len((await client.get(f"/api/v1/tables/{table_id}/history")).json()["actions"]) == 2


async def test_a_roll_back_that_cannot_be_is_a_conflict(client: httpx.AsyncClient) -> None:
    first, second = await versions(client, 2)
    path = f"/api/v1/tables/{first}/rollback"
    assert "no table of its lens is" in assert_problem(await client.post(path), "conflict")["detail"]
    await client.post(f"/api/v1/tables/{first}/approve")
    assert "no other table was approved" in assert_problem(await client.post(path), "conflict")["detail"]
    await client.post(f"/api/v1/tables/{second}/approve")
    assert f"table {second} is" in assert_problem(await client.post(path), "conflict")["detail"]
    assert (await client.post(f"/api/v1/tables/{second}/rollback")).status_code == 200
    assert_problem(await client.post(f"/api/v1/tables/{second}/rollback"), "conflict")
    assert await approved(client) == [first]


async def test_approving_changes_no_table(client: httpx.AsyncClient) -> None:
    (table_id,) = await versions(client, 1)
    before = await client.get(f"/api/v1/tables/{table_id}")
    await client.post(f"/api/v1/tables/{table_id}/approve")
    again = await client.get(f"/api/v1/tables/{table_id}", headers={"If-None-Match": before.headers["etag"]})
    assert again.status_code == 304


@pytest.mark.parametrize(
    "body",
    [{"by": ""}, {"by": "a\nb"}, {"by": "x" * 201}, {"note": ""}, {"note": "x" * 1001}, {"who": "Anna"}, [1], "x"],
)
async def test_a_wrong_action_names_its_field(client: httpx.AsyncClient, body: Any) -> None:
    (table_id,) = await versions(client, 1)
    problem = assert_problem(await client.post(f"/api/v1/tables/{table_id}/approve", json=body), "invalid")
    assert problem["errors"][0]["field"].startswith("body")
    assert await approved(client) == []


async def test_pages_of_another_origin_approve_nothing(client: httpx.AsyncClient) -> None:
    first, second = await versions(client, 2)
    await client.post(f"/api/v1/tables/{first}/approve")
    foreign = {"Origin": "https://evil.example"}
    for path in (f"/{second}/approve", f"/{first}/rollback", ""):
        assert_problem(await client.post(f"/api/v1/tables{path}", headers=foreign), "origin-refused")
    assert await approved(client) == [first]


@pytest.mark.parametrize("path", ["9/approve", "9/rollback", "9/history", "9/compare?with=1", "1/compare?with=9"])
async def test_tables_that_are_not_there(client: httpx.AsyncClient, path: str) -> None:
    await versions(client, 1)
    method = "POST" if path.endswith(("approve", "rollback")) else "GET"
    assert_problem(await client.request(method, f"/api/v1/tables/{path}"), "not-found")


# Comparison


async def test_two_versions_are_compared_in_pixels(client: httpx.AsyncClient, ledger: Repository) -> None:
    def moved(shift_px: float) -> LensTable:
        level = measured_level()
        assert level.center_shift_px is not None
        shift = (level.center_shift_px[0] + shift_px, level.center_shift_px[1])
        return replace(lens_table(), levels=(replace(level, center_shift_px=shift), *lens_table().levels[1:]))

    for shift_px in (0.0, 2.0, 0.1):
        await ledger.save_table(None, moved(shift_px))
    told = (await client.get("/api/v1/tables/1/compare", params={"with": 2})).json()
    assert (told["first"]["version"], told["second"]["version"]) == (1, 2)
    assert told["difference_px"] == {"rms": pytest.approx(2.0), "max": pytest.approx(2.0)}
    (level,) = told["levels"]
    assert (level["zoom"], level["focus"], level["measured"]) == (0.0, 0.0, [True, True])
    assert level["center_shift_px"] == pytest.approx([2.0, 0.0])
    assert level["sigma_px"] == pytest.approx(0.1 * 2**0.5)
    assert level["sigmas"] == told["most_sigmas"] == pytest.approx(2.0 / (0.1 * 2**0.5))
    assert told["agree"] is False
    assert told["verdict"].endswith("A constant centre shift of +2.000, +0.000 px explains all but 0.000 px of it.")
    assert told["explanations"][0]["cause"] == "center_shift"
    close = (await client.get("/api/v1/tables/1/compare", params={"with": 3})).json()
    assert close["agree"] is True
    assert close["verdict"].startswith("The tables agree within their stated sigmas (0.7 at most)")


async def test_tables_of_other_pictures_are_not_compared(client: httpx.AsyncClient, ledger: Repository) -> None:
    await ledger.save_table(None, replace(lens_table(), sensor_mm=(9.59, 5.39)))
    await ledger.save_table(None, replace(lens_table(), sensor_mm=(24.9, 14.0)))
    problem = assert_problem(await client.get("/api/v1/tables/1/compare?with=2"), "not-comparable")
    assert "a sensor of 9.59 x 5.39 mm there" in problem["detail"]
    assert_problem(await client.get("/api/v1/tables/1/compare"), "invalid")
    assert_problem(await client.get("/api/v1/tables/1/compare?with=0"), "invalid")
