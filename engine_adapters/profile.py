"""The studio profile: how to speak to one engine. TOML text in, frozen settings out.

Whatever the seed does not tell about the engine is a setting here. A wrong profile must not give a plausible wrong
lens: the product compares it with what a few renders show and says where they disagree.
"""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self
from urllib.parse import urlsplit

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from calibration.image import Transfer
from engine_adapters.errors import AdapterError

FILE_LIMIT_BYTES = 1024 * 1024
"""Largest profile file that is read; the full text with comments is under 10 KiB."""


class ProfileError(AdapterError):
    """A studio profile that cannot be used. ``problems`` holds one line each: key, what is wrong, what to do."""

    def __init__(self, *problems: str, where: str = "") -> None:
        self.problems = problems
        super().__init__("; ".join(problems), where=where)


def _web_address(url: str) -> str:
    parts = urlsplit(url)
    try:
        usable = parts.port != 0
    except ValueError:
        usable = False
    if parts.scheme not in ("http", "https") or not parts.hostname or not usable or parts.username is not None:
        raise ValueError("must be an http or https address without user and password")
    return url


def _quotable(text: str) -> str:
    if any(character in '"\\' or not character.isprintable() for character in text):
        raise ValueError("must not hold quotes, backslashes or control characters")
    return text


Seconds = Annotated[float, Field(gt=0, le=3600)]
Port = Annotated[int, Field(ge=1, le=65535)]
WebAddress = Annotated[str, Field(max_length=500), AfterValidator(_web_address)]
Name = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_quotable)]
Value = Annotated[str, Field(max_length=200), AfterValidator(_quotable)]
Sign = Literal[1, -1]
PositionAxis = Literal["PosX", "-PosX", "PosY", "-PosY", "PosZ", "-PosZ"]
RotationAxis = Literal["RotX", "-RotX", "RotY", "-RotY", "RotZ", "-RotZ"]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ExportNames(_Section):
    """The scene's exports, by what the product wants of them."""

    center_shift_x: Name = Field(default="lens.center_shift_x", description="centre shift to the right")
    center_shift_y: Name = Field(default="lens.center_shift_y", description="centre shift downwards")
    fov_x: Name = Field(default="lens.fov_x", description="field of view")
    k1: Name = Field(default="lens.k1", description="radial distortion, second order")
    k2: Name = Field(default="lens.k2", description="radial distortion, fourth order")
    nodal_offset: Name = Field(default="lens.nodal_offset", description="entrance pupil before the pivot")
    background: Name = Field(default="background.visible", description="the camera's picture as background, on or off")
    object: Name = Field(default="object.visible", description="the virtual target in front, on or off")

    @model_validator(mode="after")
    def _all_different(self) -> Self:
        names = list(self.model_dump().values())
        if len(set(names)) != len(names):
            raise ValueError("two exports have the same name; each needs its own")
        return self


class R3Settings(_Section):
    """The engine's text socket."""

    host: Name = Field(default="127.0.0.1", description="address of the R3 command server")
    port: Port = Field(default=9009, description="its TCP port")
    connect_timeout_s: Seconds = Field(
        default=2.0,
        description="longest wait for the connection; on loopback or a studio network it takes milliseconds",
    )
    command_timeout_s: Seconds = Field(
        default=2.0,
        description="longest wait for an answer; it comes within a few frames, so beyond this the engine is in trouble",
    )
    snapshot_timeout_s: Seconds = Field(
        default=5.0, description="longest wait for takeSnapshot: a render and a file of 0.3 s, more on a busy disk"
    )
    picture_timeout_s: Seconds = Field(default=10.0, description="longest wait for getSnapshot: megabytes of text")
    line_ending: Literal["lf", "crlf"] = Field(
        default="lf", description="how a command line ends, lf or crlf (both are understood in answers)"
    )
    encoding: Literal["utf-8", "cp1252", "latin-1"] = Field(
        default="utf-8", description="text encoding of the socket: utf-8, cp1252 or latin-1"
    )
    ordered_replies: bool = Field(
        default=True,
        description="answers come in the order of the exports; false: each export is set by a command of its own",
    )
    max_reply_mib: float = Field(default=1.0, gt=0, le=64, description="largest answer but pictures, MiB")
    max_picture_mib: float = Field(default=64.0, gt=0, le=1024, description="largest picture answer, MiB")
    getvalue_reply: Literal["tolerant", "prefixed", "ok", "bare"] = Field(
        default="tolerant",
        description="answer to getValue: prefixed = OK: SCENE EXPORT GETVALUE - value, ok = OK: value, bare = value, "
        "tolerant = any of them that cannot be mistaken",
    )
    scene: Name = Field(default="Lensmatch/Calibration", description="project and scene that hold the exports")
    tracking_camera: Name = Field(default="Cam0", description="the tracking camera to read")
    visible_on: Value = Field(default="1", description="value that shows background or object")
    visible_off: Value = Field(default="0", description="value that hides it")
    snapshot_name: Name = Field(
        default="lensmatch", description="file that snapshots are written to, in the Projects folder"
    )
    exports: ExportNames = Field(default_factory=ExportNames, description="names of the scene's exports")


class EngineSettings(_Section):
    """The engine's conventions for lens and tracking."""

    radius_unit: Literal["focal_length", "half_width", "half_height", "half_diagonal", "sensor_mm"] = Field(
        default="focal_length",
        description="radius 1 of k1 and k2: focal_length, half_width, half_height, half_diagonal, "
        "or sensor_mm (one millimetre on the sensor)",
    )
    direction: Literal["undistorted_to_distorted", "reverse"] = Field(
        default="undistorted_to_distorted",
        description="which way the polynomial goes: undistorted_to_distorted or reverse",
    )
    center_shift: Literal["offset", "absolute_pixel"] = Field(
        default="offset",
        description="centre shift as offset from the picture's centre or as absolute_pixel of the principal point",
    )
    pixel_centres: Literal["whole", "half"] = Field(
        default="whole", description="the top left pixel's centre is 0 (whole) or 0.5 (half); counts for absolute_pixel"
    )
    center_shift_sign_x: Sign = Field(default=1, description="1: positive is to the right, -1: to the left")
    center_shift_sign_y: Sign = Field(default=1, description="1: positive is down, -1: up")
    fov_axis: Literal["x", "y"] = Field(default="x", description="field of view across (x) or up and down (y)")
    fov_unit: Literal["deg", "rad"] = Field(default="deg", description="deg or rad")
    nodal_unit: Literal["mm", "m"] = Field(default="mm", description="mm or m")
    nodal_sign: Sign = Field(default=1, description="1: positive is towards the scene, -1: away from it")
    delay_frames: int = Field(
        default=2,
        ge=0,
        le=120,
        description="frames between SetValue and the picture that shows it; measured at each run's start",
    )
    tracking_position_unit: Literal["m", "cm", "mm"] = Field(
        default="m", description="unit of the packet's position: m, cm, mm"
    )
    tracking_right: PositionAxis = Field(
        default="PosX", description="field that gives the position to the right; - turns it"
    )
    tracking_forward: PositionAxis = Field(default="PosY", description="field that gives the position forward")
    tracking_up: PositionAxis = Field(default="PosZ", description="field that gives the height")
    tracking_pan: RotationAxis = Field(
        default="RotZ", description="field that gives pan, degrees, positive right; - turns it"
    )
    tracking_tilt: RotationAxis = Field(default="RotX", description="field that gives tilt, degrees, positive up")
    tracking_roll: RotationAxis = Field(
        default="RotY", description="field that gives roll, degrees, positive clockwise"
    )


class MockBoardSettings(_Section):
    """The virtual capture card's web API."""

    url: WebAddress = Field(
        default="http://localhost:1987/api/v1/MockCard/MockOutput/GetImage", description="address of GetImage"
    )
    connect_timeout_s: Seconds = Field(default=2.0, description="longest wait for the connection")
    timeout_s: Seconds = Field(default=5.0, description="longest wait for a whole picture; it takes about 0.015 s")
    max_picture_mib: float = Field(default=64.0, gt=0, le=1024, description="largest answer, MiB")
    payload: Literal["auto", "base64", "json", "data_uri"] = Field(
        default="auto",
        description="what comes: base64 text, a json string, a data_uri, or auto (told by its first characters)",
    )
    picture_format: Literal["auto", "png", "jpeg", "bmp"] = Field(
        default="auto", description="picture file inside: png, jpeg, bmp or auto"
    )
    browser_headers: bool = Field(default=True, description="send the headers of a browser, as the study did")


class HeadSettings(_Section):
    """What turns the camera and drives its lens."""

    kind: Literal["operator", "simulated", "visca"] = Field(
        default="operator", description="operator (a person is asked), simulated, or visca (not available yet)"
    )
    url: WebAddress = Field(default="http://127.0.0.1:9010/head", description="address of the simulated head")
    timeout_s: Seconds = Field(
        default=30.0, description="longest wait for a movement; a full pan of a slow head takes 20 s"
    )
    answer_timeout_s: Seconds = Field(default=1800.0, description="longest wait for a person's answer")


class TrackingSettings(_Section):
    """Where camera tracking comes from besides the engine."""

    kind: Literal["none", "freed", "opentrackio"] = Field(
        default="none", description="none, freed or opentrackio (the last two are not available yet)"
    )
    host: Name = Field(default="0.0.0.0", description="address to listen on")
    port: Port = Field(default=40000, description="UDP port to listen on")


class PictureSettings(_Section):
    """The pictures and the sensor behind them."""

    transfer: Transfer = Field(
        default=Transfer.BT709, description="how light is coded: bt709 (studio video), srgb (photographs), linear"
    )
    image_size: tuple[int, int] = Field(default=(1920, 1080), description="width and height, pixels")
    sensor_mm: tuple[float, float] = Field(default=(9.59, 5.39), description="width and height of the sensor, mm")
    pixel_aspect: float = Field(
        default=1.0, ge=0.25, le=4, description="vertical over horizontal focal length in pixels; 1 for square pixels"
    )

    @model_validator(mode="after")
    def _sizes(self) -> Self:
        if not all(16 <= side <= 16384 for side in self.image_size):
            raise ValueError("image_size must be 16 to 16384 pixels a side")
        if not all(0.5 <= side <= 500 for side in self.sensor_mm):
            raise ValueError("sensor_mm must be 0.5 to 500 mm a side")
        return self


class StudioProfile(_Section):
    """One studio: its engine, capture card, camera head, tracking and pictures. Every key has a default."""

    r3: R3Settings = Field(default_factory=R3Settings, description="R3, the render engine: text socket")
    engine: EngineSettings = Field(
        default_factory=EngineSettings, description="how the engine counts: conventions of its lens and its tracking"
    )
    mockboard: MockBoardSettings = Field(
        default_factory=MockBoardSettings, description="MockBoard, the virtual capture card: web API"
    )
    head: HeadSettings = Field(default_factory=HeadSettings, description="what turns the camera and drives its lens")
    tracking: TrackingSettings = Field(
        default_factory=TrackingSettings, description="camera tracking besides the engine's own"
    )
    picture: PictureSettings = Field(default_factory=PictureSettings, description="the pictures and the sensor")


def load_profile(path: str | Path) -> StudioProfile:
    """The profile in a TOML file; keys that are left out have their defaults. Raises ``ProfileError``."""
    where = str(path)
    try:
        with Path(path).open("rb") as file:
            data = file.read(FILE_LIMIT_BYTES + 1)
    except OSError as error:
        raise ProfileError(
            f"cannot be read ({error.strerror or error}); `lensmatch doctor --print-profile` prints one to start from",
            where=where,
        ) from error
    except ValueError as error:  # a NUL in the name
        raise ProfileError("is not a file name", where=repr(path)) from error
    if len(data) > FILE_LIMIT_BYTES:
        raise ProfileError(f"is larger than {FILE_LIMIT_BYTES} bytes; this is no studio profile", where=where)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ProfileError("is not UTF-8 text; save it as UTF-8", where=where) from error
    return parse_profile(text, where=where)


def parse_profile(text: str, *, where: str = "studio profile") -> StudioProfile:
    """The profile in a TOML text. Raises ``ProfileError``, one line for each wrong key."""
    try:
        table = tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError, or a number of thousands of digits
        raise ProfileError(f"is not TOML: {error}", where=where) from error
    except RecursionError as error:
        raise ProfileError("is not TOML: nested too deeply", where=where) from error
    try:
        # As JSON, strictly: a list may become a pair and a text an enum, but never a text a number.
        return StudioProfile.model_validate_json(json.dumps(table, default=str), strict=True)
    except ValidationError as error:
        raise ProfileError(*(_problem(details) for details in error.errors()), where=where) from error


def require_available(profile: StudioProfile) -> None:
    """Refuse a valid profile that asks for what this version cannot do. Raises ``ProfileError``."""
    problems = []
    if profile.head.kind == "visca":
        problems.append(VISCA_NOT_AVAILABLE)
    if profile.tracking.kind != "none":
        problems.append(f'tracking.kind = "{profile.tracking.kind}": not available yet; use "none"')
    if problems:
        raise ProfileError(*problems, where="studio profile")


VISCA_NOT_AVAILABLE = 'head.kind = "visca": not available yet; use "operator" or "simulated"'


def profile_toml(profile: StudioProfile | None = None) -> str:
    """A profile (the defaults where none is given) as TOML with a comment for every key; reads back to the same."""
    lines = ["# Lensmatch studio profile: how to speak to one engine. Keys that are left out have these defaults."]
    _write_section(lines, profile or StudioProfile(), "")
    return "\n".join(lines) + "\n"


def profile_sha256(profile: StudioProfile) -> str:
    """SHA-256, hexadecimal, of a profile's canonical text: every key with its value, the defaults too, as sorted JSON.

    Files that say the same in another order, or leave out defaults, have the same.
    """
    canonical = json.dumps(profile.model_dump(mode="json"), sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def _write_section(lines: list[str], section: BaseModel, path: str) -> None:
    subsections: list[tuple[str, BaseModel, str]] = []
    for key, field in type(section).model_fields.items():
        value = getattr(section, key)
        comment = field.description or ""
        if isinstance(value, BaseModel):
            subsections.append((f"{path}.{key}" if path else key, value, comment))
        else:
            lines += [f"# {comment}", f"{key} = {_toml_value(value)}"]
    for name, value, comment in subsections:
        lines += ["", f"# {comment}", f"[{name}]"]
        _write_section(lines, value, name)


def _toml_value(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml_value(item) for item in value) + "]"
    # JSON's texts, numbers and booleans are TOML's too (names hold no DEL, the one difference).
    return json.dumps(value, ensure_ascii=False)


def _problem(details: Any) -> str:
    key = ".".join(str(part) for part in details["loc"])
    kind = details["type"]
    if kind == "extra_forbidden":
        return f"{key}: unknown key; remove it or check its spelling"
    message = details["msg"].removeprefix("Value error, ")
    # A password in an address stays out of errors and logs.
    given = re.sub(r"//[^/@]*@", "//...@", repr(details.get("input")))
    shown = "" if isinstance(details.get("input"), dict) else f" = {given[:60]}"
    return f"{key}{shown}: {message[:1].lower()}{message[1:]}"
