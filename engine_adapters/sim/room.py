"""What stands in the simulated studio: the targets, and the reddish things that are none.

World axes and target axes are those of the conventions; colours are coded BT.709 (B, G, R), 0..255. Seen from the
camera's pivot nothing overlaps a target.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Colour = tuple[int, int, int]

PIVOT_M = (0.0, 0.0, 1.6)
"""The camera's pivot: on the axis of the room, at the height of the targets' centres."""

_RED: Colour = (34, 28, 196)
_WHITE: Colour = (226, 228, 230)
_BLACK: Colour = (24, 24, 26)
_WALL: Colour = (52, 148, 46)
_DIM = 0.62
_COLOUR_NAMES = {_RED: "red", _WHITE: "white", _BLACK: "black"}


class RoomKind(StrEnum):
    """Which targets stand in the room."""

    BOARDS = "boards"
    SQUARE = "square"
    LIGHT = "light"
    DEPTH = "depth"
    """Boards at two distances, as the nodal offset needs them; no two have as many squares."""


@dataclass(frozen=True)
class Panel:
    """A flat target: a checker of ``squares`` (columns, rows), ``cell_m`` (width, height) each, in a margin.

    ``colours``: that of the top left square, then the other. At yaw, pitch, roll 0 it faces the camera (normal -Y),
    columns along +X, rows along -Z; yaw about Z, pitch about X, roll about Y, intrinsic, right-handed, degrees.
    """

    name: str
    squares: tuple[int, int]
    cell_m: tuple[float, float]
    colours: tuple[Colour, Colour]
    centre_m: tuple[float, float, float]
    margin_m: float = 0.0
    margin_colour: Colour = _WHITE
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    @cached_property
    def half_m(self) -> tuple[float, float]:
        """Half the width and height of the checker, without its margin."""
        return self.squares[0] * self.cell_m[0] / 2.0, self.squares[1] * self.cell_m[1] / 2.0

    @cached_property
    def axes(self) -> FloatArray:
        """World directions of the columns (right), the rows (down) and the normal (to the camera) as rows, (3, 3)."""
        yaw, pitch, roll = (math.radians(angle) for angle in (self.yaw_deg, self.pitch_deg, self.roll_deg))
        across = np.array([math.cos(yaw), math.sin(yaw), 0.0])
        away = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
        up = np.array([0.0, 0.0, 1.0])
        away_pitched = math.cos(pitch) * away + math.sin(pitch) * up
        up_pitched = math.cos(pitch) * up - math.sin(pitch) * away
        across_rolled = math.cos(roll) * across - math.sin(roll) * up_pitched
        up_rolled = math.cos(roll) * up_pitched + math.sin(roll) * across
        return np.stack([across_rolled, -up_rolled, -away_pitched])

    def to_world(self, plane_m: FloatArray) -> FloatArray:
        """Points (right, down) of the panel's plane (N, 2) in the world (N, 3), metres."""
        return np.asarray(self.centre_m, dtype=np.float64) + plane_m @ self.axes[:2]

    def survey(self) -> dict[str, Any]:
        """What an operator would write down about it: an entry of a picture set's ``targets``."""
        pose = {
            "centre_m": list(self.centre_m),
            "yaw_deg": self.yaw_deg,
            "pitch_deg": self.pitch_deg,
            "roll_deg": self.roll_deg,
        }
        if self.squares == (1, 1):
            return {"kind": "square", "size_m": list(self.cell_m), "colours": ["red"], "pose": pose}
        return {
            "kind": "chessboard",
            "squares": list(self.squares),
            "square_m": self.cell_m[0],
            "colours": [_COLOUR_NAMES[colour] for colour in self.colours],
            "pose": pose,
        }


@dataclass(frozen=True, slots=True)
class Lamp:
    """A small bright disk that faces the camera."""

    name: str
    centre_m: tuple[float, float, float]
    diameter_m: float

    def survey(self) -> dict[str, Any]:
        """An entry of a picture set's ``targets``."""
        pose = {"centre_m": list(self.centre_m), "yaw_deg": 0.0, "pitch_deg": 0.0, "roll_deg": 0.0}
        return {"kind": "light", "diameter_m": self.diameter_m, "pose": pose}


@dataclass(frozen=True, slots=True)
class Decoy:
    """A flat coloured polygon of the backdrop: ``outline_m`` (N, 3), drawn in order; ``smooth`` edges or plain."""

    outline_m: FloatArray
    colour: Colour
    smooth: bool = True


@dataclass(frozen=True, slots=True)
class Room:
    """The targets and the backdrop, far to near."""

    kind: RoomKind
    panels: tuple[Panel, ...]
    lamps: tuple[Lamp, ...]
    backdrop: tuple[Decoy, ...]
    pivot_m: tuple[float, float, float] = PIVOT_M

    def survey(self) -> dict[str, Any]:
        """The operator's survey: ``targets`` as in a picture set, and the camera's ``pivot_m``."""
        things: list[Panel | Lamp] = [*self.panels, *self.lamps]
        return {
            "targets": {thing.name: thing.survey() for thing in things},
            "pivot_m": list(self.pivot_m),
        }


def build_room(kind: RoomKind = RoomKind.BOARDS) -> Room:
    """The demo studio with its boards; or with plain red squares, boards and a phone's light, boards at two distances.

    The boards' sizes stand to each other as a 20x zoom needs: there is always one that fills the picture well.
    """
    large, small, tiny = (-0.6, 5.0, 1.6), (0.35, 5.0, 1.6), (0.06, 5.0, 1.6)
    panels: tuple[Panel, ...]
    if kind is RoomKind.SQUARE:
        panels = (
            Panel("square_large", (1, 1), (0.6, 0.6), (_RED, _RED), large),
            Panel("square_small", (1, 1), (0.18, 0.18), (_RED, _RED), small),
        )
    else:
        panels = (
            Panel("board_large", (9, 7), (0.1, 0.1), (_RED, _WHITE), large, margin_m=0.04),
            Panel("board_small", (8, 6), (0.03, 0.03), (_RED, _BLACK), small, margin_m=0.015),
            Panel("board_tiny", (7, 5), (0.008, 0.008), (_RED, _WHITE), tiny, margin_m=0.004),
        )
    if kind is RoomKind.DEPTH:
        panels = (
            *panels,
            Panel("near_large", (10, 8), (0.04, 0.04), (_RED, _WHITE), (0.75, 2.2, 1.6), margin_m=0.02),
            Panel("near_small", (9, 6), (0.012, 0.012), (_RED, _BLACK), (-0.8, 2.2, 1.6), margin_m=0.007),
            Panel("near_tiny", (6, 5), (0.004, 0.004), (_RED, _WHITE), (-0.55, 2.2, 1.6), margin_m=0.002),
        )
    lamps = (Lamp("light", (0.0, 5.0, 1.6), 0.01),) if kind is RoomKind.LIGHT else ()
    return Room(kind, panels, lamps, tuple(_backdrop(panels)))


def _backdrop(panels: tuple[Panel, ...]) -> Iterator[Decoy]:
    yield from _shell()
    yield from _green_wall()
    yield from _curtain()
    for panel in panels:
        x, y, z = panel.centre_m
        bottom = z - panel.half_m[1] - panel.margin_m - 0.02
        width = 0.03 if panel.half_m[0] > 0.2 else 0.014
        yield from _box(x - width / 2, x + width / 2, y + 0.02, y + 0.02 + width, 0.0, bottom, (92, 92, 92))
    yield from _furniture()


def _shell() -> Iterator[Decoy]:
    """Dark walls and ceiling far out, and the grey floor."""
    dark: Colour = (26, 24, 24)
    corners = [(-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0)]
    for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True):
        yield _flat([(x0, y0, 0.0), (x1, y1, 0.0), (x1, y1, 6.0), (x0, y0, 6.0)], dark)
    yield _flat([(x, y, 6.0) for x, y in corners], (20, 19, 19))
    yield _flat([(x, y, 0.0) for x, y in corners], (88, 86, 84))
    # Lighter boards of the floor, one beside the other, so that a turn of the head is seen.
    for column in range(-3, 3):
        for row in range(-1, 3):
            shade = 92 + 3 * ((column * 5 + row * 3) % 4)
            x0, x1 = column * 2.0 + 0.01, column * 2.0 + 1.99
            y0, y1 = row * 2.0 + 0.01, row * 2.0 + 1.99
            yield _flat([(x0, y0, 0.0), (x1, y0, 0.0), (x1, y1, 0.0), (x0, y1, 0.0)], (shade, shade - 2, shade - 3))


def _green_wall() -> Iterator[Decoy]:
    """A chroma wall, brighter where the key light falls: rings of one shade each, from the dark rim inwards."""
    y, rings, points = 6.0, 16, 36
    left, right, top = -2.9, 3.7, 3.6
    angles = np.linspace(0.0, 2.0 * math.pi, points, endpoint=False)
    yield _flat([(left, y, 0.0), (right, y, 0.0), (right, y, top), (left, y, top)], _shaded(_WALL, _DIM))
    for ring in range(1, rings + 1):
        share = ring / (rings + 1)
        radius = math.sqrt(-math.log(share))
        x = np.clip(0.5 + radius * 2.3 * np.cos(angles), left, right)
        z = np.clip(2.2 + radius * 1.7 * np.sin(angles), 0.0, top)
        outline = np.column_stack([x, np.full(points, y), z])
        yield Decoy(outline, _shaded(_WALL, _DIM + 0.48 * share), smooth=False)


def _curtain() -> Iterator[Decoy]:
    folds = 16
    for fold in range(folds):
        x0 = -4.3 + 1.6 * fold / folds
        light = 0.7 + 0.4 * math.sin(fold * 1.9) ** 2
        yield _flat(
            [(x0, 5.6, 0.05), (x0 + 0.1, 5.6, 0.05), (x0 + 0.1, 5.6, 3.5), (x0, 5.6, 3.5)],
            _shaded((26, 20, 118), light),
            smooth=False,
        )


def _furniture() -> Iterator[Decoy]:
    """Reddish things that are no target, none of them in front of one as seen from the pivot."""
    yield _flat(_upright(0.72, 0.98, 5.95, 1.66, 1.92), (30, 30, 32))
    yield _flat(_upright(0.74, 0.96, 5.95, 1.68, 1.90), (150, 96, 214))
    yield _flat(_upright(-0.35, 0.25, 5.97, 2.30, 2.46), (112, 128, 224))
    yield _flat(_upright(1.55, 2.15, 5.95, 2.28, 2.52), (22, 22, 24))
    yield _flat(_upright(1.60, 2.10, 5.94, 2.33, 2.47), (40, 36, 226))
    yield _flat(_upright(1.35, 1.55, 5.4, 0.95, 1.22), (44, 36, 168))
    for number, colour in enumerate(((140, 44, 190), (226, 80, 60), (48, 52, 186), (196, 60, 120))):
        yield _flat(_upright(-2.35 + 0.2 * number, -2.15 + 0.2 * number, 5.7, 0.95, 2.05), colour)
    yield from _box(1.15, 1.5, 5.2, 5.5, 0.0, 0.85, (196, 200, 202))
    yield from _box(1.2, 1.45, 5.25, 5.45, 0.85, 1.08, (52, 60, 170))
    yield from _box(1.9, 2.2, 4.9, 5.2, 0.0, 2.0, (34, 26, 150))
    yield from _box(-1.9, -1.55, 4.7, 5.0, 0.0, 1.05, (26, 20, 158))
    yield from _box(-0.9, 0.75, 3.8, 4.3, 0.0, 0.62, (58, 78, 112))
    yield _flat(_upright(-0.9, 0.75, 3.79, 0.34, 0.46), (40, 28, 172))
    yield from _box(-0.98, 0.83, 3.72, 4.36, 0.62, 0.68, (206, 210, 212))
    yield from _box(-0.25, -0.05, 4.0, 4.1, 0.68, 0.84, (40, 38, 38))
    yield from _box(0.42, 0.5, 3.95, 4.03, 0.68, 0.78, (34, 92, 226))
    yield from _box(1.0, 1.5, 3.0, 3.4, 0.0, 0.3, (112, 132, 226))


def _upright(x0: float, x1: float, y: float, z0: float, z1: float) -> list[tuple[float, float, float]]:
    return [(x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1)]


def _box(x0: float, x1: float, y0: float, y1: float, z0: float, z1: float, colour: Colour) -> Iterator[Decoy]:
    """The faces of a box that the camera can see from where it stands."""
    px, _, pz = PIVOT_M
    if px < x0:
        yield _flat([(x0, y0, z0), (x0, y1, z0), (x0, y1, z1), (x0, y0, z1)], _shaded(colour, 0.66))
    if px > x1:
        yield _flat([(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)], _shaded(colour, 0.74))
    if pz > z1:
        yield _flat([(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)], _shaded(colour, 1.12))
    yield _flat(_upright(x0, x1, y0, z0, z1), colour)


def _shaded(colour: Colour, light: float) -> Colour:
    blue, green, red = (min(255, round(part * light)) for part in colour)
    return blue, green, red


def _flat(corners: list[tuple[float, float, float]], colour: Colour, *, smooth: bool = True) -> Decoy:
    """A polygon, its sides divided finely enough to bend with the lens."""
    points = np.array(corners, dtype=np.float64)
    following = np.roll(points, -1, axis=0)
    parts = []
    for start, end in zip(points, following, strict=True):
        pieces = max(1, min(24, round(float(np.linalg.norm(end - start)) / 0.4)))
        steps = np.arange(pieces)[:, np.newaxis] / pieces
        parts.append(start + (end - start) * steps)
    outline = np.concatenate(parts)
    outline.setflags(write=False)
    return Decoy(outline, colour, smooth)
