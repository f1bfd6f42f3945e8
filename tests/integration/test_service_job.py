"""The main job as a client of the service sees it: posted over HTTP, watched over WebSocket, downloaded as a table.

The service is a process of its own, and so is the simulated studio: every byte goes through a real socket.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.asyncio.client import connect

from app.cli.simulated import studio_job, studio_profile, true_lens
from calibration.compare import overlay
from engine_adapters.profile import profile_toml
from engine_adapters.r3.client import R3Engine
from engine_adapters.sim.launch import launched_studio
from engine_adapters.sim.lens_truth import embedded_lens_names, load_embedded
from storage.exports import EXPORTS

LENS = load_embedded(embedded_lens_names()[0])
FAST = ("--picture-time-ms", "4", "--head-speed", "2000")
BOUND_S = 60.0

pytestmark = [pytest.mark.slow, pytest.mark.timeout(120)]


class Client:
    """A client of a running service."""

    def __init__(self, url: str, http: httpx.AsyncClient, process: asyncio.subprocess.Process) -> None:
        self.http = http
        self.process = process
        self._sockets = url.replace("http://", "ws://")

    async def post(self, addresses: dict[str, Any], *levels: tuple[float, float]) -> str:
        document = studio_job(addresses, LENS, levels).model_dump(mode="json", exclude_none=True)
        answer = await self.http.post("/api/v1/jobs", json=document)
        assert answer.status_code == 201, answer.text
        return str(answer.json()["id"])

    async def job(self, job_id: str) -> dict[str, Any]:
        return dict((await self.http.get(f"/api/v1/jobs/{job_id}")).raise_for_status().json())

    async def events(self, job_id: str) -> AsyncIterator[dict[str, Any]]:
        """Every event of a job as its socket tells it, to its end."""
        async with asyncio.timeout(BOUND_S), connect(f"{self._sockets}/api/v1/jobs/{job_id}/events") as socket:
            async for message in socket:
                yield json.loads(message)


@contextlib.asynccontextmanager
async def service(lensmatch: Any) -> AsyncIterator[Client]:
    """``lensmatch serve`` on the studio whose profile is ``studio.toml``."""
    async with lensmatch.started("serve", "--port", "0", "--profile", "studio.toml", "--json") as process:
        text = b""
        async with asyncio.timeout(BOUND_S):
            while not text.rstrip().endswith(b"}"):
                text += (line := await process.stdout.readline())
                assert line, (await process.stderr.read()).decode()
        url = json.loads(text)["url"]
        async with httpx.AsyncClient(base_url=url, trust_env=False, timeout=30) as http:
            yield Client(url, http, process)


@contextlib.asynccontextmanager
async def studio(folder: Path) -> AsyncIterator[tuple[dict[str, Any], R3Engine]]:
    """A simulated studio with its profile in ``studio.toml``, and an adapter that looks at its engine."""
    async with launched_studio(FAST) as addresses:
        profile = studio_profile(addresses, LENS)
        (folder / "studio.toml").write_text(profile_toml(profile), "utf-8")
        engine = R3Engine.from_profile(profile)
        try:
            yield addresses, engine
        finally:
            await engine.close()


async def test_a_job_is_posted_watched_and_downloaded(lensmatch: Any) -> None:
    levels = [(1 / 6, 0.25), (1 / 6, 0.75)]
    async with studio(lensmatch.folder) as (addresses, engine), service(lensmatch) as client:
        found = await engine.read_state()
        job_id = await client.post(addresses, *levels)
        kinds = []
        async for event in client.events(job_id):
            kinds.append(event["kind"])
            if event["kind"] == "level_done":
                stored = [result["ordinal"] for result in (await client.job(job_id))["results"]]
                assert event["ordinal"] in stored, "a level is in the store before its event is told"
        assert kinds.count("level_done") == 2
        assert kinds[0] == "job_queued"
        assert kinds[-1] == "job_done"
        assert kinds.index("engine_restored") < len(kinds) - 1
        assert await engine.read_state() == found

        job = await client.job(job_id)
        assert job["state"] == "done"
        path = f"/api/v1/tables/{job['table_id']}"
        table = EXPORTS["json"].read((await client.http.get(path)).content)
        assert EXPORTS["csv"].read((await client.http.get(path, params={"format": "csv"})).content) == table
        assert [(level.zoom, level.focus) for level in table.levels] == levels
        for level in table.levels:
            assert overlay(true_lens(LENS, level.zoom, level.focus), level.lens(table.image_size)).max_px < 0.15
        for kind in ("before", "overlay", "residuals"):
            picture = await client.http.get(f"/api/v1/jobs/{job_id}/levels/{1 / 6}/0.25/picture?kind={kind}")
            assert picture.headers["content-type"] == "image/jpeg", picture.text


async def test_the_table_of_a_job_is_published_and_stays_in_the_engine(lensmatch: Any) -> None:
    async with studio(lensmatch.folder) as (addresses, engine), service(lensmatch) as client:
        found = dict((await engine.read_state()).exports)
        made = await client.post(addresses, (1 / 6, 0.25))
        assert [event["kind"] async for event in client.events(made)][-1] == "job_done"
        table_id = (await client.job(made))["table_id"]
        place = {"zoom": 1 / 6, "focus": 0.25}
        answer = await client.http.post(f"/api/v1/tables/{table_id}/publish", json=place)
        assert answer.status_code == 201, answer.text
        job_id = answer.headers["location"].rpartition("/")[2]
        events = [event async for event in client.events(job_id)]
        assert events[-1]["kind"] == "job_done", events[-1]
        (published,) = [event for event in events if event["kind"] == "published"]
        assert published["kept"]
        assert published["compared"]
        assert published["render_px"]["max"] < 0.15
        now = dict((await engine.read_state()).exports)
        assert {value["name"]: value["got"] for value in published["values"]}.items() <= now.items()
        assert {name for name in found if found[name] != now[name]} <= {value["name"] for value in published["values"]}
        lens = true_lens(LENS, 1 / 6, 0.25)
        assert (await engine.read_lens()).fov_x_deg == pytest.approx(lens.fov_x_deg, rel=1e-3)
        assert (await client.job(job_id))["kind"] == "publish"


async def test_a_cancelled_job_gives_the_engine_back_as_it_was_found(lensmatch: Any) -> None:
    async with studio(lensmatch.folder) as (addresses, engine), service(lensmatch) as client:
        found = await engine.read_state()
        job_id = await client.post(addresses, (0.0, 0.25), (0.5, 0.25), (1.0, 0.25))
        kinds: list[str] = []
        async for event in client.events(job_id):
            kinds.append(event["kind"])
            if kinds.count("capture") == 3 and kinds[-1] == "capture":
                assert (await client.http.post(f"/api/v1/jobs/{job_id}/cancel")).status_code == 202
        assert kinds[-1] == "job_cancelled"
        assert "engine_restored" in kinds
        assert await engine.read_state() == found
        assert (await client.job(job_id))["state"] == "cancelled"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
async def test_a_killed_service_keeps_the_finished_levels(lensmatch: Any) -> None:
    async with studio(lensmatch.folder) as (addresses, _):
        async with service(lensmatch) as client:
            job_id = await client.post(addresses, (0.0, 0.25), (0.5, 0.25), (1.0, 0.25))
            async with contextlib.aclosing(client.events(job_id)) as events:
                async for event in events:
                    if event["kind"] == "level_done":
                        break
            done = (await client.job(job_id))["results"][0]
            client.process.send_signal(signal.SIGKILL)
            await client.process.wait()
        async with service(lensmatch) as client:
            job = await client.job(job_id)
            assert job["state"] == "failed"
            assert "finished levels are kept" in job["reason"]
            assert job["results"][0] == done
