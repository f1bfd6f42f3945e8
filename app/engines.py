"""The engines that this service may use, and the lease: one engine, one user at a time."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import Any, NoReturn

from app.errors import ServiceError
from calibration.image import Transfer
from engine_adapters.errors import AdapterError
from engine_adapters.ports import CameraHead, EngineState, FrameSource, RenderEngine

RESTORE_BOUND_S = 15.0
"""Longest wait for an engine to take its values back: three commands with their own time-outs and one reopening."""


class EngineError(ServiceError):
    """Base: an engine that cannot be leased."""


class UnknownEngine(EngineError):
    """No engine of that name. The message lists those there are."""


class EngineInUse(EngineError):
    """Another job holds the engine."""


class StudioMismatch(EngineError):
    """A job says another thing of the engine's pictures than its studio profile. The message names both values."""


@dataclass(frozen=True, slots=True)
class PictureFacts:
    """What a studio profile says of its pictures: width and height in px, vertical over horizontal focal length in
    pixels."""

    image_size: tuple[int, int]
    pixel_aspect: float


@dataclass(frozen=True, slots=True)
class ProfileFacts:
    """Which studio profile an engine has: its name, and the SHA-256 of its canonical text, hexadecimal."""

    name: str
    sha256: str


@dataclass(frozen=True, slots=True)
class EngineFacts:
    """What a studio profile says of how its engine counts, in the profile's own words (``engine.*``)."""

    image_size: tuple[int, int] = (1920, 1080)
    pixel_aspect: float = 1.0
    sensor_width_mm: float = 9.59
    radius_unit: str = "focal_length"
    direction: str = "undistorted_to_distorted"
    center_shift: str = "offset"
    pixel_centres: str = "whole"
    center_shift_signs: tuple[int, int] = (1, 1)
    fov_axis: str = "x"
    nodal_sign: int = 1

    @property
    def unit_px(self) -> Mapping[str, float | None]:
        """Radius 1 of k1 and k2 in px for each unit that the profile knows; None: the focal length."""
        half_width = self.image_size[0] / 2
        half_height = self.image_size[1] / (2 * self.pixel_aspect)
        return {
            "focal_length": None,
            "half_width": half_width,
            "half_height": half_height,
            "half_diagonal": math.hypot(half_width, half_height),
            "sensor_mm": self.image_size[0] / self.sensor_width_mm,
        }

    def unit_gain(self, unit: str, focal_gain: float) -> tuple[int, float]:
        """(unit_power, k1_gain) of :class:`calibration.solve.engine_model.EngineModel` for an engine that counts in
        ``unit`` behind this profile, its focal length ``focal_gain`` times the one asked for."""
        half_width = self.image_size[0] / 2
        says, behaves = self.unit_px[self.radius_unit], self.unit_px[unit]
        power = (says is None) - (behaves is None)
        gain = ((says or half_width) / (behaves or half_width * focal_gain)) ** 2
        return power, gain


@dataclass(frozen=True, slots=True)
class Studio:
    """What a job talks to: an engine, its output, and what turns the camera. ``transfer``: how pictures code light;
    ``facts``: what the profile says of the engine."""

    engine: RenderEngine
    frames: FrameSource
    head: CameraHead
    transfer: Transfer = Transfer.BT709
    facts: EngineFacts = EngineFacts()

    async def close(self) -> None:
        """Release every connection."""
        async with AsyncExitStack() as stack:
            for port in (self.engine, self.frames, self.head):
                stack.push_async_callback(port.close)


@dataclass(frozen=True, slots=True)
class EngineInfo:
    """An engine as shown to clients. ``dirty``: why its values may not be as they were found, or None; ``found``: then
    the (name, value) pairs that are to be put back."""

    name: str
    address: str
    job_id: str | None
    dirty: str | None
    found: tuple[tuple[str, str], ...] = ()


@dataclass(slots=True)
class _Slot:
    address: str
    connect: Callable[[], Studio]
    pictures: PictureFacts | None
    profile: ProfileFacts | None
    job_id: str | None = None
    dirty: str | None = None
    found: EngineState | None = None


@dataclass(slots=True)
class Lease:
    """An engine held by one job. Values as found are put back when the lease ends, but for those that it keeps.

    ``kept``: (name, value) pairs that stay, empty where none do; a lease that ends by an error or a cancellation keeps
    none.
    """

    studio: Studio
    found: EngineState
    kept: tuple[tuple[str, str], ...] = ()
    restored: bool = False
    problem: str | None = None

    def keep(self, values: Iterable[tuple[str, str]]) -> None:
        """Let these exports, as the engine now holds them, stay when the lease ends well.

        Sends nothing: at the end they are set with all others, so that a value lost meanwhile is set again. Raises
        :class:`EngineError` for an export that was not there when the engine was found.
        """
        values = tuple(values)
        known = {name for name, _ in self.found.exports}
        for name, _ in values:
            if name not in known:
                raise EngineError(f"export {name!r} was not read when the engine was leased; it cannot be kept")
        self.kept = values

    @property
    def at_end(self) -> EngineState:
        """What the engine is left with: as found, with the kept values in their places."""
        kept = dict(self.kept)
        return EngineState(tuple((name, kept.get(name, value)) for name, value in self.found.exports))


class Engines:
    """The engines by name; each is leased to one job at a time."""

    def __init__(self) -> None:
        self._slots: dict[str, _Slot] = {}

    def add(
        self,
        name: str,
        address: str,
        connect: Callable[[], Studio],
        pictures: PictureFacts | None = None,
        profile: ProfileFacts | None = None,
    ) -> None:
        """Make an engine known. ``connect`` makes its adapters; connections are opened at their first use.

        ``pictures``: what its profile says of its pictures, for :meth:`require_pictures`; None: nothing is known.
        ``profile``: which one that is, for :meth:`profile`.
        """
        self._slots[name] = _Slot(address, connect, pictures, profile)

    def names(self) -> Iterable[str]:
        return tuple(self._slots)

    def infos(self) -> list[EngineInfo]:
        return [
            EngineInfo(name, slot.address, slot.job_id, slot.dirty, slot.found.exports if slot.found else ())
            for name, slot in self._slots.items()
        ]

    def profile(self, name: str) -> ProfileFacts | None:
        """The studio profile of an engine, None where that is not known. Raises :class:`UnknownEngine`."""
        self.require(name)
        return self._slots[name].profile

    def require(self, name: str) -> None:
        """Raise :class:`UnknownEngine` unless there is an engine of this name."""
        if name not in self._slots:
            known = ", ".join(sorted(self._slots)) or "none"
            raise UnknownEngine(f"no engine is called {name!r}; this service knows: {known}")

    def require_pictures(self, name: str, wanted: PictureFacts) -> None:
        """Raise :class:`StudioMismatch` unless a job and the engine's profile say the same of its pictures.

        A job solved with another pixel aspect than the engine renders with would be wrong without a sign of it.
        Raises :class:`UnknownEngine` too.
        """
        self.require(name)
        known = self._slots[name].pictures
        if known is None:
            return
        if wanted.image_size != known.image_size:
            told, said = ("x".join(map(str, size)) for size in (wanted.image_size, known.image_size))
            _mismatch("image_size", told, said)
        if not math.isclose(wanted.pixel_aspect, known.pixel_aspect, rel_tol=1e-9):
            _mismatch("pixel_aspect", f"{wanted.pixel_aspect:.12g}", f"{known.pixel_aspect:.12g}")

    @asynccontextmanager
    async def lease(self, name: str, job_id: str) -> AsyncIterator[Lease]:
        """Hold an engine; on leaving, however that happens, its values are put back as they were found (but for those
        that :meth:`Lease.keep` keeps, where all went well).

        Raises :class:`UnknownEngine`, :class:`EngineInUse`, or the adapters' errors when the engine is not there. The
        lease object then tells whether the values could be put back (``restored``, ``problem``); if not, the engine
        is dirty and the next lease puts them back first.
        """
        self.require(name)
        slot = self._slots[name]
        if slot.job_id is not None:
            raise EngineInUse(f"engine {name!r} is in use by job {slot.job_id}")
        slot.job_id = job_id
        try:
            studio = slot.connect()
            try:
                lease = await self._begin(slot, studio)
                try:
                    yield lease
                except BaseException:
                    lease.kept = ()
                    raise
                finally:
                    await self._end_for_sure(slot, lease)
            finally:
                await studio.close()
        finally:
            slot.job_id = None

    async def _begin(self, slot: _Slot, studio: Studio) -> Lease:
        if slot.found is not None:
            await studio.engine.restore(slot.found)
            slot.found, slot.dirty = None, None
        return Lease(studio, await studio.engine.read_state())

    async def _end_for_sure(self, slot: _Slot, lease: Lease) -> None:
        try:
            await _finish_shielded(self._end(slot, lease))
        except asyncio.CancelledError:
            if lease.kept:
                # Cancelled while its end was written: a cancelled job keeps nothing.
                lease.kept, lease.restored = (), False
                await _finish_shielded(self._end(slot, lease))
            raise

    async def _end(self, slot: _Slot, lease: Lease) -> None:
        try:
            async with asyncio.timeout(RESTORE_BOUND_S):
                for attempt in (1, 2):
                    try:
                        await lease.studio.engine.restore(lease.at_end)
                        break
                    except AdapterError:
                        # The first try may meet a connection that a cancelled exchange has closed.
                        if attempt == 2:
                            raise
            lease.restored, lease.problem = True, None
            slot.found, slot.dirty = None, None
        except (AdapterError, TimeoutError) as error:
            lease.problem = str(error) or f"not within {RESTORE_BOUND_S:g} s"
            slot.found, slot.dirty = lease.at_end, lease.problem


def _mismatch(field: str, job: str, profile: str) -> NoReturn:
    raise StudioMismatch(
        f"the job's {field} {job} is not the studio profile's {profile} ([picture] {field}): correct one of them"
    )


async def _finish_shielded(work: Coroutine[Any, Any, None]) -> None:
    """Await a bounded coroutine to its end even if the caller is cancelled meanwhile; re-raise the cancellation."""
    task = asyncio.create_task(work)
    cancelled: asyncio.CancelledError | None = None
    while not task.done():
        try:
            await asyncio.shield(task)
        except asyncio.CancelledError as error:
            if task.cancelled():
                raise
            cancelled = error
    task.result()
    if cancelled is not None:
        raise cancelled
