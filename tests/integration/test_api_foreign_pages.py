"""Pages and host names of others: the service answers to its own names only, and to its own pages."""

from __future__ import annotations

import json

import httpx
import pytest

from storage.repository import Repository
from tests.support.service import JOB, assert_problem

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
    client: httpx.AsyncClient, ledger: Repository, headers: dict[str, str]
) -> None:
    body = json.dumps(JOB).encode()
    for method in ("POST", "PUT", "PATCH", "DELETE"):
        for kind in ("application/json", "text/plain", "multipart/form-data; boundary=x", "text/html", ""):
            sent = {**headers, "Content-Type": kind}
            assert_problem(await client.request(method, "/api/v1/jobs", content=body, headers=sent), "origin-refused")
    assert (await ledger.list_jobs()).jobs == ()


@pytest.mark.parametrize("origin", ["http://127.0.0.1:8000", "https://studio.example", "HTTPS://STUDIO.EXAMPLE"])
async def test_own_pages_may(client: httpx.AsyncClient, origin: str) -> None:
    assert (await client.post("/api/v1/jobs", json=JOB, headers={"Origin": origin})).status_code == 201


async def test_two_origins_are_refused(client: httpx.AsyncClient) -> None:
    two = [("Origin", "http://127.0.0.1:8000"), ("Origin", "http://127.0.0.1:8000")]
    assert_problem(await client.post("/api/v1/jobs", json=JOB, headers=two), "origin-refused")
