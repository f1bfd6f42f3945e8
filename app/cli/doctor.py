"""``lensmatch doctor``: checks what a job needs, one by one, and says what to do about what is missing."""

from __future__ import annotations

import asyncio
import os
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated

import typer

from app.bootstrap import DEFAULT_ENGINE, make_studio, utc_now
from app.cli.configuration import build_settings, studio_profile
from app.cli.console import (
    EXIT_FAILED,
    KNOWN_ERRORS,
    messages,
    os_reason,
    print_json,
    reported_errors,
    results,
    wrong_usage,
)
from app.engines import Engines, Studio
from app.jobs.cpu import Cpu
from app.jobs.taking import PictureTaker
from app.settings import Settings
from calibration.image import decode_picture
from engine_adapters.pictures import picture_format
from engine_adapters.profile import StudioProfile, profile_toml
from storage.repository import Repository

_PACKAGES = ("fastapi", "httpx", "numpy", "opencv-python-headless", "pydantic", "scipy", "sqlmodel", "uvicorn")
_OLDEST_PYTHON = (3, 11)
_MIB = 1024 * 1024
_FETCHES = 3
_CPU_BOUND_S = 10.0
# Longest wait for one decoded picture in a worker thread; it takes 0.1 s.


@dataclass(frozen=True, slots=True)
class Check:
    """One check: what was found, and what to do where it failed."""

    name: str
    ok: bool
    detail: str
    advice: str = ""


class _Failed(Exception):
    """A check failed: what was found, and what to do."""

    def __init__(self, detail: str, advice: str) -> None:
        self.detail = detail
        self.advice = advice
        super().__init__(detail)


def doctor(
    studio: Annotated[
        Path | None,
        typer.Option(
            metavar="PROFILE",
            help="studio profile (TOML) [default: the first of LENSMATCH_PROFILES, else an engine on this host]",
        ),
    ] = None,
    database: Annotated[Path | None, typer.Option(help="SQLite file to check")] = None,
    measure_delay: Annotated[
        bool,
        typer.Option(
            "--measure-delay",
            help="switch the engine's background off and on, see after how long the output follows, and put it back",
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON document on standard output")] = False,
    print_profile: Annotated[
        bool,
        typer.Option("--print-profile", help="print a studio profile with every default and its meaning, and stop"),
    ] = False,
) -> None:
    """Check Python, database, disk, engine, MockBoard and camera head, and say what to do about what fails."""
    if print_profile:
        with reported_errors(as_json):
            if as_json:
                wrong_usage("--print-profile prints TOML; leave out --json")
        results.file.write(profile_toml())
        return
    with reported_errors(as_json):
        settings = build_settings(database=database)
        profile, source = studio_profile(studio, settings)
        checks = asyncio.run(_checks(settings, profile, source, measure_delay))
        ok = all(check.ok for check in checks)
        if as_json:
            print_json({"ok": ok, "checks": [asdict(check) for check in checks]})
        else:
            _show(checks)
        if not ok:
            raise typer.Exit(EXIT_FAILED)


async def _checks(settings: Settings, profile: StudioProfile, source: str, measure_delay: bool) -> list[Check]:
    cpu = Cpu(settings.cpu_workers)
    checks: list[Check] = []

    async def add(name: str, check: Callable[[], Awaitable[str]]) -> None:
        messages.print(f"[dim]checking {name} ...[/]")
        checks.append(await _outcome(name, check))

    try:
        await add("python", _python)
        await add("packages", _packages)
        await add("database", lambda: _database(settings))
        await add("disk", lambda: _disk(settings))
        await add("workers", lambda: _workers(settings, cpu))
        await add("profile", lambda: _profile(profile, source))
        if not checks[-1].ok:
            return checks
        connected = make_studio(profile)
        try:
            await add("engine", lambda: _engine(connected, profile))
            await add("tracking", lambda: _tracking(connected))
            await add("mockboard", lambda: _mockboard(connected, profile, cpu))
            if measure_delay:
                await add("output", lambda: _output(profile, cpu))
            await add("head", lambda: _head(connected, profile))
        finally:
            await connected.close()
    finally:
        cpu.close()
    return checks


async def _outcome(name: str, check: Callable[[], Awaitable[str]]) -> Check:
    try:
        return Check(name, True, await check())
    except _Failed as error:
        return Check(name, False, error.detail, error.advice)
    except KNOWN_ERRORS as error:
        # These messages end in what to do, behind the last semicolon.
        detail, _, advice = str(error).rpartition("; ")
        return Check(name, False, detail or advice, advice if detail else "see the message; the profile may be wrong")
    except TimeoutError:
        return Check(name, False, "no answer in time", "is the machine overloaded? Try again")
    except OSError as error:
        return Check(name, False, os_reason(error), "correct the file or its permissions")


async def _python() -> str:
    here = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    if sys.version_info < _OLDEST_PYTHON:
        raise _Failed(here, f"install Python {'.'.join(map(str, _OLDEST_PYTHON))} or later")
    return here


async def _packages() -> str:
    found = []
    for name in ("lensmatch", *_PACKAGES):
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            if name != "lensmatch":  # run from a checkout, it is not installed
                raise _Failed(f"{name} is not installed", "python -m pip install .") from None
    return ", ".join(found)


async def _database(settings: Settings) -> str:
    path = settings.database
    if not await asyncio.to_thread(path.exists):
        return f"{path}: will be made"
    async with await Repository.open(path, utc_now) as repository:
        await repository.check()
        waiting = len(await repository.unfinished_jobs())
    return f"{path}: in order, {waiting} unfinished jobs"


async def _disk(settings: Settings) -> str:
    folder, free = await asyncio.to_thread(_free_space, settings.database)
    need = settings.min_free_disk_bytes
    told = f"{folder}: {free // _MIB} MiB free"
    if free < need:
        raise _Failed(told, f"free some space, {need // _MIB} MiB are needed, or set LENSMATCH_DATABASE elsewhere")
    return told


def _free_space(database: Path) -> tuple[Path, int]:
    """The folder the database lies in, or will, and its free bytes. Raises OSError where it cannot be written to."""
    folder = database.absolute().parent
    while not folder.is_dir() and folder != folder.parent:
        folder = folder.parent
    with tempfile.TemporaryFile(dir=folder) as probe:
        probe.write(b"lensmatch")
    return folder, shutil.disk_usage(folder).free


async def _workers(settings: Settings, cpu: Cpu) -> str:
    async with asyncio.timeout(_CPU_BOUND_S):
        started = time.perf_counter()
        await asyncio.gather(*(cpu.run(time.sleep, 0) for _ in range(settings.cpu_workers)))
        took = time.perf_counter() - started
    return f"{settings.cpu_workers} threads on {os.cpu_count()} processors answer in {1000 * took:.0f} ms"


async def _profile(profile: StudioProfile, source: str) -> str:
    make_studio(profile)
    width, height = profile.picture.image_size
    return f"{source}: scene {profile.r3.scene!r}, pictures {width}x{height}"


async def _engine(studio: Studio, profile: StudioProfile) -> str:
    started = time.perf_counter()
    state = await studio.engine.read_state()
    took = time.perf_counter() - started
    lens = await studio.engine.read_lens()
    return (
        f"R3 at {profile.r3.host}:{profile.r3.port} gave {len(state.exports)} exports in {1000 * took:.0f} ms; "
        f"FoV {lens.fov_x_deg:.3f} deg, k1 {lens.k1:.5g}, k2 {lens.k2:.5g}"
    )


async def _tracking(studio: Studio) -> str:
    camera = await studio.engine.tracking()
    x, y, z = camera.pivot_m
    return f"{camera.name} at ({x:.3f}, {y:.3f}, {z:.3f}) m, pan {camera.pan_deg:.3f}, tilt {camera.tilt_deg:.3f} deg"


async def _mockboard(studio: Studio, profile: StudioProfile, cpu: Cpu) -> str:
    fetch_s, decode_s = [], []
    size, form = (0, 0), ""
    for _ in range(_FETCHES):
        frame = await studio.frames.fetch()
        fetch_s.append(frame.received_at_s - frame.requested_at_s)
        form = picture_format(frame.data, where=frame.source)
        started = time.perf_counter()
        picture = await cpu.run(decode_picture, frame.data)
        decode_s.append(time.perf_counter() - started)
        size = (picture.shape[1], picture.shape[0])
    wanted = profile.picture.image_size
    told = f"{profile.mockboard.url}: {form} {size[0]}x{size[1]}, fetched in {1000 * min(fetch_s):.0f} ms, "
    told += f"decoded in {1000 * min(decode_s):.0f} ms"
    if size != wanted:
        raise _Failed(told, f"set picture.image_size of the profile (it says {wanted[0]}x{wanted[1]}) or the output")
    return told


async def _output(profile: StudioProfile, cpu: Cpu) -> str:
    engines = Engines()
    engines.add(DEFAULT_ENGINE, "", lambda: make_studio(profile))
    async with engines.lease(DEFAULT_ENGINE, "doctor") as lease:
        taker = PictureTaker(lease.studio, profile.picture.image_size, cpu)
        await taker.measure_delay()
    if not lease.restored:
        raise _Failed(f"the engine's values could not be put back: {lease.problem}", "look at the engine's scene")
    return f"follows a change within {1000 * taker.delay.delay_s:.0f} ms; the engine has its values back"


async def _head(studio: Studio, profile: StudioProfile) -> str:
    if profile.head.kind == "operator":
        return "operator: a person is asked for each movement"
    state = await studio.head.read()
    return (
        f"{profile.head.kind} at {profile.head.url}: pan {state.pan_deg:.3f}, tilt {state.tilt_deg:.3f} deg, "
        f"zoom {state.zoom:.3f}, focus {state.focus:.3f}"
    )


def _show(checks: list[Check]) -> None:
    for check in checks:
        mark = "[green]ok[/]    " if check.ok else "[bold red]failed[/]"
        results.print(f"{mark} {check.name:<10}", end="")
        results.print(check.detail, markup=False)
        if check.advice:
            results.print(f"       what to do: {check.advice}", markup=False)
