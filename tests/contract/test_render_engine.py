"""What every render engine keeps, real or replayed or simulated."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import astuple, replace
from typing import Any

import pytest

from engine_adapters.errors import AdapterError, UnsafeText
from engine_adapters.ports import LensValues, RenderEngine, Shown

RunCheck = Callable[[Callable[[Any], Awaitable[None]]], Awaitable[None]]

LENS = LensValues(71.262261, k1=-0.191619, k2=0.0689969, center_shift_px=(3.0, -2.0), nodal_offset_mm=121.3)
PLAIN = LensValues(45.0)


def flat(values: LensValues) -> list[float]:
    fov_x_deg, k1, k2, (right_px, down_px), nodal_offset_mm = astuple(values)
    return [fov_x_deg, k1, k2, right_px, down_px, nodal_offset_mm]


async def test_the_lens_reads_back_as_it_was_set(on_engine: RunCheck) -> None:
    async def check(engine: RenderEngine) -> None:
        for values in (LENS, PLAIN):
            await engine.apply(values)
            assert flat(await engine.read_lens()) == pytest.approx(flat(values), rel=1e-12, abs=1e-12)

    await on_engine(check)


async def test_each_value_of_the_lens_reads_back_with_its_export(on_engine: RunCheck) -> None:
    async def check(engine: RenderEngine) -> None:
        await engine.apply(LENS)
        held = await engine.read_back(LENS)
        assert [back.name for back in held if not back.same] == []
        state = dict((await engine.read_state()).exports)
        assert {back.name: back.got for back in held} == {back.name: state[back.name] for back in held}
        other = await engine.read_back(replace(LENS, k1=-0.2))
        assert [(back.same, float(back.asked) != float(back.got)) for back in other].count((False, True)) == 1

    await on_engine(check)


async def test_stating_a_goal_twice_is_stating_it_once(on_engine: RunCheck) -> None:
    async def check(engine: RenderEngine) -> None:
        await engine.apply(LENS)
        await engine.show(Shown.VIRTUAL)
        once = await engine.read_state()
        await engine.apply(LENS)
        await engine.show(Shown.VIRTUAL)
        assert await engine.read_state() == once

    await on_engine(check)


async def test_restore_leaves_the_engine_as_it_was_found(on_engine: RunCheck) -> None:
    async def check(engine: RenderEngine) -> None:
        found = await engine.read_state()
        await engine.apply(LENS)
        await engine.show(Shown.BOTH)
        assert await engine.read_state() != found
        await engine.restore(found)
        assert await engine.read_state() == found

    await on_engine(check)


async def test_each_way_of_showing_is_a_state_of_its_own(on_engine: RunCheck) -> None:
    async def check(engine: RenderEngine) -> None:
        seen = set()
        for shown in Shown:
            await engine.show(shown)
            seen.add((await engine.read_state()).exports[-2:])
        assert len(seen) == len(Shown)

    await on_engine(check)


async def test_showing_leaves_the_lens(on_engine: RunCheck) -> None:
    async def check(engine: RenderEngine) -> None:
        await engine.apply(LENS)
        await engine.show(Shown.NOTHING)
        assert flat(await engine.read_lens()) == pytest.approx(flat(LENS), rel=1e-12)

    await on_engine(check)


async def test_the_tracking_packet_is_in_product_units(on_engine: RunCheck) -> None:
    async def check(engine: RenderEngine) -> None:
        camera = await engine.tracking()
        assert camera.name == "Cam0"
        assert all(abs(metres) < 100 for metres in camera.pivot_m)
        assert 0 < camera.pivot_m[2] < 3, "a camera stands between the floor and three metres"
        assert all(abs(degrees) <= 360 for degrees in (camera.pan_deg, camera.tilt_deg, camera.roll_deg))
        assert camera.fov_x_deg is None or 0 < camera.fov_x_deg < 180

    await on_engine(check)


@pytest.mark.parametrize("values", [LensValues(0.0), LensValues(180.0), LensValues(60.0, k1=float("inf"))])
async def test_an_impossible_lens_is_refused_and_changes_nothing(on_engine: RunCheck, values: LensValues) -> None:
    async def check(engine: RenderEngine) -> None:
        found = await engine.read_state()
        with pytest.raises(UnsafeText):
            await engine.apply(values)
        assert await engine.read_state() == found

    await on_engine(check)


async def test_calls_at_once_are_answered_each_its_own(on_engine: RunCheck) -> None:
    async def check(engine: RenderEngine) -> None:
        await engine.apply(LENS)
        lenses = await asyncio.gather(*(engine.read_lens() for _ in range(5)))
        assert all(lens == lenses[0] for lens in lenses)

    await on_engine(check)


async def test_a_closed_engine_answers_with_a_typed_error(on_engine: RunCheck) -> None:
    async def check(engine: RenderEngine) -> None:
        await engine.close()
        with pytest.raises(AdapterError):
            await engine.read_lens()

    await on_engine(check)
