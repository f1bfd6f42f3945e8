"""Parts of events: what stands in a field of theirs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Number = Annotated[float, Field(allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0)]


class FramesData(BaseModel):
    """How many pictures a level took."""

    model_config = ConfigDict(frozen=True)

    real: Count = Field(description="of the camera")
    virtual: Count = Field(description="of the engine's own render")


class EngineModelData(BaseModel):
    """How an engine draws, against a profile that is right: all gains 1, offsets 0, ``unit_power`` 0."""

    model_config = ConfigDict(frozen=True)

    direction: Literal["undistorted_to_distorted", "reverse"]
    unit_power: int = Field(description="1 or -1: k1 grows with the focal length squared, or its inverse, besides")
    focal_gain: Number
    k1_gain: Number
    k2_gain: Number
    shift_gain: tuple[Number, Number]
    shift_offset_px: tuple[Number, Number]
    nodal_gain: Number
    aspect_gain: Number


class CheckedLevelData(BaseModel):
    """A level that was measured again, against the stored lens."""

    model_config = ConfigDict(frozen=True)

    zoom: Number
    focus: Number
    error_px: Number = Field(description="largest overlay error of the stored lens over the frame, px")
    expected_px: Number = Field(description="one sigma of it, for a lens that holds, px")
    left_px: Number | None = Field(default=None, description="what the correction leaves of it, px; null: none")


class RemountData(BaseModel):
    """What a remount moved, new minus stored; null: not needed to explain what was measured."""

    model_config = ConfigDict(frozen=True)

    center_shift_px: tuple[Number, Number] | None = None
    center_shift_sigma_px: tuple[Number, Number] | None = None
    zoom_offset: Number | None = Field(default=None, description="of the encoder value of the same ring position")
    zoom_offset_sigma: Number | None = None
    focus_offset: Number | None = Field(default=None, description="of the encoder value of the same ring position")
    focus_offset_sigma: Number | None = None
