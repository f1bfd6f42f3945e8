"""A simulated studio for the demo and the benchmarks: its process, its profile, its job, and what it asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import httpx

from app.bootstrap import DEFAULT_ENGINE, add_engine
from app.documents import JobRequest, PlanModel
from app.engines import Engines
from calibration.lens import Lens
from engine_adapters.profile import StudioProfile, parse_profile, profile_toml
from engine_adapters.sim.lens_truth import ZoomLens

STUDY_ZOOMS, STUDY_FOCUSES = 7, 2
FOCUS_RANGE = (0.25, 0.75)
# The study's focus 1 and 2; more focuses are spread between them.

_STATS_BOUND_S = 5.0


@dataclass(frozen=True, slots=True)
class StudioUse:
    """What a client asked of a simulated studio. ``engine_bound_s`` is the least time it could have taken: pictures x
    picture time + changes of a value or pose x the engine's delay + movements of head and lens."""

    pictures: int
    changes: int
    movements: int
    movements_s: float
    picture_time_s: float
    delay_s: float
    render_ms_mean: float

    @property
    def engine_bound_s(self) -> float:
        return self.pictures * self.picture_time_s + (self.changes + self.movements) * self.delay_s + self.movements_s

    def since(self, before: StudioUse) -> StudioUse:
        """What was asked for after ``before``."""
        return StudioUse(
            self.pictures - before.pictures,
            self.changes - before.changes,
            self.movements - before.movements,
            self.movements_s - before.movements_s,
            self.picture_time_s,
            self.delay_s,
            self.render_ms_mean,
        )


def study_levels(zooms: int = STUDY_ZOOMS, focuses: int = STUDY_FOCUSES) -> list[tuple[float, float]]:
    """Levels (zoom, focus): the study's 13 by default (zooms 1 to 7, focuses 1 and 2, without zoom 7 focus 2)."""
    zoom_values = [i / (zooms - 1) if zooms > 1 else 0.0 for i in range(zooms)]
    near, far = FOCUS_RANGE
    focus_values = [near + (far - near) * i / (focuses - 1) if focuses > 1 else near for i in range(focuses)]
    levels = [(zoom, focus) for zoom in zoom_values for focus in focus_values]
    return levels[:-1] if (zooms, focuses) == (STUDY_ZOOMS, STUDY_FOCUSES) else levels


def studio_profile(addresses: dict[str, Any], lens: ZoomLens) -> StudioProfile:
    """The profile that speaks to a simulated studio with this lens at these addresses."""
    base = StudioProfile()
    return base.model_copy(
        update={
            "r3": base.r3.model_copy(update=addresses["r3"]),
            "mockboard": base.mockboard.model_copy(
                update={"url": addresses["mockboard"]["url"] + "/api/v1/MockCard/MockOutput/GetImage"}
            ),
            "head": base.head.model_copy(update={"kind": "simulated", "url": addresses["head"]["url"] + "/head"}),
            "picture": base.picture.model_copy(
                update={"image_size": lens.image_size, "pixel_aspect": lens.pixel_aspect}
            ),
        }
    )


def studio_engines(profile: StudioProfile, *, slow_pictures: bool = False) -> Engines:
    """The simulated studio as the default engine."""
    engines = Engines()
    checked = parse_profile(profile_toml(profile), where="profile of the simulated studio")
    add_engine(engines, DEFAULT_ENGINE, checked, slow_pictures=slow_pictures, profile_name="simulated studio")
    return engines


def studio_job(
    addresses: dict[str, Any],
    lens: ZoomLens,
    levels: Sequence[tuple[float, float]],
    method: str = "joint",
    plan: PlanModel | None = None,
) -> JobRequest:
    """A job from the room's survey: what an operator with a tape measure would write down. No truth of the lens.

    ``plan`` instead of ``levels``: it chooses them.
    """
    survey = addresses["survey"]
    return JobRequest.model_validate(
        {
            "job": 1,
            "lens": lens.name,
            "camera": "Cam0",
            "method": method,
            "image_size": list(lens.image_size),
            "sensor_mm": list(lens.sensor_mm),
            "pixel_aspect": lens.pixel_aspect,
            "levels": [{"zoom": zoom, "focus": focus} for zoom, focus in levels],
            "plan": plan,
            "targets": survey["targets"],
            "pivot_m": survey["pivot_m"],
        }
    )


def true_lens(lens: ZoomLens, zoom: float, focus: float) -> Lens:
    """The truth at a level, for judging a finished result; nothing that measures may see it."""
    state = lens.at(zoom, focus)
    optics = state.optics
    return Lens(
        lens.image_size,
        optics.f_px,
        optics.k1,
        optics.k2,
        optics.center_shift_px,
        lens.pixel_aspect,
        state.nodal_offset_mm,
    )


async def studio_use(addresses: dict[str, Any], picture_time_s: float, delay_frames: int) -> StudioUse:
    """What has been asked of the studio so far."""
    async with httpx.AsyncClient(timeout=_STATS_BOUND_S, trust_env=False) as client:
        told = (await client.get(addresses["head"]["url"] + "/stats")).raise_for_status().json()
    return StudioUse(
        told["pictures"],
        told["changes"],
        told["movements"],
        told["movements_s"],
        picture_time_s,
        delay_frames * picture_time_s,
        told["render_ms_mean"],
    )
