"""The camera head of the simulated studio: HTTP with JSON.

``GET /head`` answers ``{"pan_deg", "tilt_deg", "roll_deg", "zoom", "focus"}``; ``POST /head`` with the angles, or with
zoom and focus, answers the same when everything stands still.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Self
from urllib.parse import urlsplit

from engine_adapters.errors import ProtocolError, Refused, UnsafeText
from engine_adapters.http import BoundedHttp
from engine_adapters.ports import HeadState
from engine_adapters.profile import HeadSettings, StudioProfile

ANSWER_LIMIT_BYTES = 64 * 1024
"""Largest answer: five numbers, or an error text."""

CONNECT_TIMEOUT_S = 2.0
"""Longest wait for the connection: it is on this machine or on the studio network."""


def head_url(url: str) -> str:
    """The address of the head; given only the server's address, its own path is added."""
    return url.rstrip("/") + "/head" if urlsplit(url).path in ("", "/") else url


class SimulatedHead:
    """The camera head port (:class:`engine_adapters.ports.CameraHead`) on a simulated studio."""

    def __init__(self, settings: HeadSettings) -> None:
        self._url = head_url(settings.url)
        self._where = f"camera head at {self._url}"
        self._http = BoundedHttp(
            what="camera head",
            hint="start the simulated studio, or set head.url of the studio profile",
            connect_timeout_s=min(CONNECT_TIMEOUT_S, settings.timeout_s),
            timeout_s=settings.timeout_s,
            limit_bytes=ANSWER_LIMIT_BYTES,
        )

    @classmethod
    def from_profile(cls, profile: StudioProfile) -> Self:
        """A head at the profile's address."""
        return cls(profile.head)

    async def move_to(self, *, pan_deg: float, tilt_deg: float, roll_deg: float = 0.0) -> HeadState:
        """Turn the head; returns when it stands still."""
        return await self._post({"pan_deg": pan_deg, "tilt_deg": tilt_deg, "roll_deg": roll_deg})

    async def set_lens(self, *, zoom: float, focus: float) -> HeadState:
        """Drive zoom and focus (0..1); returns when the lens stands still."""
        for name, value in (("zoom", zoom), ("focus", focus)):
            if not 0.0 <= value <= 1.0:
                raise UnsafeText(f"{name} = {value}: must be 0 to 1", where=self._where)
        return await self._post({"zoom": zoom, "focus": focus})

    async def read(self) -> HeadState:
        """Where head and lens stand now."""
        return self._state(*await self._http.request("GET", self._url))

    async def close(self) -> None:
        """Close the connections. Safe to call twice."""
        await self._http.close()

    async def _post(self, goal: Mapping[str, float]) -> HeadState:
        for name, value in goal.items():
            if not math.isfinite(value):
                raise UnsafeText(f"{name} = {value}: must be a finite number", where=self._where)
        return self._state(*await self._http.request("POST", self._url, json=dict(goal)))

    def _state(self, status: int, body: bytes) -> HeadState:
        try:
            answer = json.loads(body)
        except (ValueError, RecursionError):
            answer = None
        if status != 200:
            told = answer.get("error") if isinstance(answer, dict) else None
            raise Refused(f"HTTP {status}{f': {told}' if told else ''}", where=self._where)
        if not isinstance(answer, dict):
            raise ProtocolError(f"the answer is no JSON object: {body[:60]!r}", where=self._where)
        values = []
        for name in ("pan_deg", "tilt_deg", "roll_deg", "zoom", "focus"):
            value = answer.get(name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                raise ProtocolError(f"the answer gives {name} = {value!r}, which is no number", where=self._where)
            values.append(float(value))
        return HeadState(*values)
