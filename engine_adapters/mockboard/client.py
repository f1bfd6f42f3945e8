"""Pictures from the MockBoard's web API (seed 5.1.1), without blocking and with every wait and size bounded."""

from __future__ import annotations

import asyncio
import time
from concurrent.futures import Executor
from functools import partial
from typing import Self
from urllib.parse import urlsplit

from engine_adapters.errors import BadPicture, Refused
from engine_adapters.http import BoundedHttp
from engine_adapters.mockboard.payload import decode_payload
from engine_adapters.ports import EncodedFrame
from engine_adapters.profile import MockBoardSettings, StudioProfile

GET_IMAGE_PATH = "/api/v1/MockCard/MockOutput/GetImage"

BROWSER_HEADERS = {
    "Accept": "text/html, application/xhtml+xml, application/xml;q=0.9, image/avif, image/webp, image/apng, */*;q=0.8, "
    "application/signed-exchange;v=b3;q=0.7",
    # The study's list ends with "br, zstd", which would only be unpacked with further packages installed; base64 of
    # a compressed picture gains nothing from them.
    "Accept-Encoding": "gzip, deflate",
    "Accept-Language": "pt-PT, pt;q=0.9, en-US;q=0.8, en;q=0.7",
    "Cache-Control": "max-age=0",
    "Connection": "keep-alive",
    "Sec-Fetch-Dest": "document",
    "Sec-Fetch-Mode": "navigate",
    "Sec-Fetch-Site": "none",
    "Sec-Fetch-User": "?1",
    "Upgrade-Insecure-Requests": "1",
    "User-Agent": "Mozilla/5.0 (Windows NT 10.0; Win64; x64) AppleWebKit/537.36 (KHTML, like Gecko) "
    "Chrome/133.0.0.0 Safari/537.36",
    "sec-ch-ua": '"Not(A:Brand";v="99", "Google Chrome";v="133", "Chromium";v="133"',
    "sec-ch-ua-mobile": "?0",
    "sec-ch-ua-platform": '"Windows"',
}
"""The headers that the study sends (seed, Table 9.1); Host follows from the address."""


def image_url(url: str) -> str:
    """The address of GetImage; given only the server's address, the MockBoard's own path is added."""
    return url.rstrip("/") + GET_IMAGE_PATH if urlsplit(url).path in ("", "/") else url


class MockBoardFrames:
    """The frame source port (:class:`engine_adapters.ports.FrameSource`) on a MockBoard."""

    def __init__(self, settings: MockBoardSettings, *, executor: Executor | None = None) -> None:
        self._settings = settings
        self._executor = executor
        self._url = image_url(settings.url)
        self._limit_bytes = int(settings.max_picture_mib * 1024 * 1024)
        self._http = BoundedHttp(
            what="MockBoard",
            hint="start R3 with the MockBoard as its output, or set mockboard.url of the studio profile",
            connect_timeout_s=settings.connect_timeout_s,
            timeout_s=settings.timeout_s,
            limit_bytes=self._limit_bytes,
            headers=BROWSER_HEADERS if settings.browser_headers else {"Accept-Encoding": "gzip, deflate"},
        )

    @classmethod
    def from_profile(cls, profile: StudioProfile, *, executor: Executor | None = None) -> Self:
        """A source at the profile's address. Connects with the first fetch."""
        return cls(profile.mockboard, executor=executor)

    async def fetch(self) -> EncodedFrame:
        """The picture that the output shows now.

        Raises ``Refused`` (any answer but 200), ``BadPicture``, ``ProtocolError``, ``TimedOut``, ``Unreachable``.
        A cancellation closes the request's connection.
        """
        requested_at_s = time.monotonic()
        status, body = await self._http.request("GET", self._url)
        received_at_s = time.monotonic()
        where = f"MockBoard at {self._url}"
        if status != 200:
            told = "; redirects are not followed" if 300 <= status < 400 else ""
            raise Refused(f"HTTP {status}{told}", where=where, command="GetImage")
        decode = partial(
            decode_payload,
            body,
            payload=self._settings.payload,
            picture_format=self._settings.picture_format,
            limit_bytes=self._limit_bytes,
        )
        try:
            # Megabytes of base64 take milliseconds, which the event loop does not have.
            data = await asyncio.get_running_loop().run_in_executor(self._executor, decode)
        except BadPicture as error:
            raise BadPicture(str(error), where=where) from error
        return EncodedFrame(data, requested_at_s, received_at_s, source=where)

    async def close(self) -> None:
        """Close the connections. Safe to call twice."""
        await self._http.close()
