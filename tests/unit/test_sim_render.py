"""The simulated pictures against brute force and against where the optics put an edge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.types import Picture
from engine_adapters.sim.light import code, light_of, light_of_colour
from engine_adapters.sim.optics import Optics, View
from engine_adapters.sim.render import PIXEL_APERTURE_VARIANCE, VIRTUAL_BLUR_PX, render_real, render_virtual
from engine_adapters.sim.room import PIVOT_M, Panel, Room, RoomKind, build_room

WIDE = Optics((1920, 1080), 1652.6, -0.24, 0.13, (3.4, -2.1), pixel_aspect=1.0008)
TELE = Optics((1920, 1080), 13_900.0, 6.3, 0.9, (-2.2, 1.8))
FloatArray = NDArray[np.float64]


def brute_force(view: View, room: Room, sigma_px: float, pixels: NDArray[np.intp]) -> FloatArray:
    """Light (N, 3) at pixels (u, v), black behind: the Gaussian's mean over 200 x 200 rays for each pixel."""
    optics = view.optics
    steps = np.linspace(-5.0, 5.0, 201)
    weights = np.exp(-steps * steps / 2)
    weights = np.outer(weights, weights) / weights.sum() ** 2
    du, dv = np.meshgrid(steps * sigma_px, steps * sigma_px)
    cu, cv = optics.center_px
    lights = np.zeros((len(pixels), 3))
    for number, (u, v) in enumerate(pixels):
        x_d, y_d = (u + du - cu) / optics.f_px, (v + dv - cv) / (optics.f_px * optics.pixel_aspect)
        r_d = np.hypot(x_d, y_d)
        r = r_d.copy()
        for _ in range(25):
            q = r * r
            r -= (r * (1 + optics.k1 * q + optics.k2 * q * q) - r_d) / (1 + 3 * optics.k1 * q + 5 * optics.k2 * q * q)
        scale = np.divide(r, r_d, out=np.ones_like(r), where=r_d > 0)[..., np.newaxis]
        right, down, forward = view.axes
        ray = scale * (x_d[..., np.newaxis] * right + y_d[..., np.newaxis] * down) + forward
        light = np.zeros((*r.shape, 3))
        for panel in room.panels:
            _look_at(panel, ray, view.pupil_m, light)
        lights[number] = (light * weights[..., np.newaxis]).sum(axis=(0, 1))
    return lights


def _look_at(panel: Panel, ray: FloatArray, pupil_m: FloatArray, light: FloatArray) -> None:
    across, down, normal = panel.axes
    centre = np.asarray(panel.centre_m) - pupil_m
    point = ray * ((centre @ normal) / (ray @ normal))[..., np.newaxis] - centre
    a, b = point @ across, point @ down
    half_a, half_b = panel.half_m
    light[(np.abs(a) < half_a + panel.margin_m) & (np.abs(b) < half_b + panel.margin_m)] = light_of_colour(
        panel.margin_colour
    )
    inside = (np.abs(a) < half_a) & (np.abs(b) < half_b)
    odd = (np.floor((a + half_a) / panel.cell_m[0]) + np.floor((b + half_b) / panel.cell_m[1])) % 2 == 1
    light[inside & ~odd] = light_of_colour(panel.colours[0])
    light[inside & odd] = light_of_colour(panel.colours[1])


@pytest.mark.parametrize(
    ("optics", "pan_deg", "tilt_deg", "roll_deg", "kind"),
    [
        (WIDE, -25.0, 10.0, 0.0, RoomKind.BOARDS),
        (WIDE, 30.0, -12.0, 0.0, RoomKind.BOARDS),
        (WIDE, 3.0, 2.0, 45.0, RoomKind.BOARDS),
        (WIDE, -24.0, 12.0, 8.0, RoomKind.SQUARE),
        (TELE, -5.1, 1.03, 0.0, RoomKind.BOARDS),
        (TELE, 4.0, 0.3, -33.0, RoomKind.BOARDS),
        (replace(WIDE, k1=0.4, k2=0.2), 20.0, 8.0, 0.0, RoomKind.BOARDS),
        (replace(WIDE, f_px=600.0, k1=-0.08, k2=0.01), 4.0, -2.0, 5.0, RoomKind.BOARDS),  # squares of 1 to 12 px
    ],
)
def test_edges_and_corners_equal_brute_force(
    optics: Optics, pan_deg: float, tilt_deg: float, roll_deg: float, kind: RoomKind
) -> None:
    room = build_room(kind)
    view = View(optics, PIVOT_M, pan_deg, tilt_deg, roll_deg, nodal_offset_mm=35.0)
    picture = render_virtual(view, room)
    steep = np.zeros(picture.shape[:2])
    steep[1:-1, 1:-1] = np.abs(picture[1:-1, 2:].astype(int) - picture[1:-1, :-2]).max(axis=2)
    steep[1:-1, 1:-1] += np.abs(picture[2:, 1:-1].astype(int) - picture[:-2, 1:-1]).max(axis=2)
    rows, columns = np.nonzero(steep > 20)
    chosen = np.random.default_rng(5).choice(len(rows), 60, replace=False)
    pixels = np.column_stack([columns[chosen], rows[chosen]])
    sigma_px = float(np.sqrt(VIRTUAL_BLUR_PX**2 + PIXEL_APERTURE_VARIANCE))
    expected = code(brute_force(view, room, sigma_px, pixels).astype(np.float32)).astype(int)
    error = picture[pixels[:, 1], pixels[:, 0]].astype(int) - expected
    # The brute force itself steps by 0.03 px, worth 2 of 255 on an edge that lies along its steps.
    assert np.abs(error).max() <= 3
    assert np.abs(error).mean() < 0.35


def edge_positions(picture: Picture, rows: range, near: FloatArray, channel: int, reach: int = 12) -> FloatArray:
    """Where the light's step stands in each row, by its integral (no model of the blur)."""
    columns = np.rint(near).astype(int)[:, np.newaxis] + np.arange(-reach, reach + 1)
    light = light_of(picture[np.array(rows)[:, np.newaxis], columns, channel]).astype(float)
    left, right = light[:, :1], light[:, -1:]
    share = (light - right) / (left - right)
    return np.asarray(columns[:, 0] - 0.5 + share.sum(axis=1))


@pytest.mark.parametrize("blur_px", [0.5, 1.7])
@pytest.mark.parametrize("kind", [RoomKind.BOARDS, RoomKind.SQUARE])
def test_edges_stand_within_a_hundredth_of_a_pixel(kind: RoomKind, blur_px: float) -> None:
    # Before the plain dark: the integral below would take the wall's own falling light for a part of the edge.
    room = replace(build_room(kind), backdrop=())
    panel = room.panels[0]
    view = View(replace(WIDE, pixel_aspect=1.0), PIVOT_M, -18.0, 7.0)
    picture = render_real(view, room, blur_px)
    # The first inner edge of the board, or the left edge of the square, in the middle of its first row of cells.
    across = -panel.half_m[0] + (panel.cell_m[0] if kind is RoomKind.BOARDS else 0.0)
    down = np.linspace(-panel.half_m[1] + 0.3 * panel.cell_m[1], -panel.half_m[1] + 0.7 * panel.cell_m[1], 200)
    edge = view.project(panel.to_world(np.column_stack([np.full(200, across), down])))
    rows = range(int(np.ceil(edge[0, 1])), int(np.floor(edge[-1, 1])))
    expected = np.interp(list(rows), edge[:, 1], edge[:, 0])
    # Green tells red from white best; red tells it from the dark.
    found = edge_positions(picture, rows, expected, channel=1 if kind is RoomKind.BOARDS else 2)
    assert len(rows) >= 8
    assert abs(float(np.mean(found - expected))) < 0.01
    assert float(np.abs(found - expected).max()) < 0.03


def test_a_light_stands_where_the_optics_put_it() -> None:
    room = build_room(RoomKind.LIGHT)
    optics = Optics((1920, 1080), 5000.0, 0.1, 0.0, (5.3, -3.6))
    picture = render_virtual(View(optics, PIVOT_M), room)
    # The light's surroundings only: the tiny board hangs 28 px to the right of it.
    light = light_of(picture[500:580, 940:990, 1]).astype(float)
    v, u = np.mgrid[500:580, 940:990]
    centre = (light * u).sum() / light.sum(), (light * v).sum() / light.sum()
    assert centre == pytest.approx((959.5 + 5.3, 539.5 - 3.6), abs=0.01)
    assert light.sum() == pytest.approx(np.pi * 5.0**2, rel=0.01)


def test_the_virtual_picture_is_black_but_for_its_targets() -> None:
    room = build_room()
    picture = render_virtual(View(WIDE, PIVOT_M), room)
    panel = room.panels[0]
    assert picture.shape == (1080, 1920, 3)
    assert not picture[:300].any()
    (u, v) = np.rint(View(WIDE, PIVOT_M).project(panel.to_world(np.array([[-0.4, -0.3]])))[0]).astype(int)
    assert tuple(picture[v, u]) == panel.colours[0]


def test_nothing_of_the_backdrop_overlaps_a_target() -> None:
    for kind in RoomKind:
        room = build_room(kind)
        view = View(replace(WIDE, f_px=1400.0), PIVOT_M)
        both = render_real(view, room, VIRTUAL_BLUR_PX)
        targets = render_virtual(view, room)
        for panel in room.panels:
            inside = np.array([[-0.49, -0.49], [0.49, 0.49]]) * np.array(panel.squares) * np.array(panel.cell_m)
            (u0, v0), (u1, v1) = np.rint(view.project(panel.to_world(inside))).astype(int)
            assert np.array_equal(both[v0 + 6 : v1 - 5, u0 + 6 : u1 - 5], targets[v0 + 6 : v1 - 5, u0 + 6 : u1 - 5])


def test_the_object_is_drawn_over_the_cameras_picture() -> None:
    room = build_room()
    real = render_real(View(WIDE, PIVOT_M), room, 0.6)
    both = render_virtual(View(WIDE, PIVOT_M, pan_deg=3.0), room, over=real)
    assert np.array_equal(both[:300], real[:300])
    assert (both != real).any(axis=2).sum() > 10_000


@pytest.mark.parametrize(
    ("optics", "turn"),
    [
        (Optics((1920, 1080), 1000.0, -0.9, 0.0), {}),  # folds inside the picture
        (Optics((1920, 1080), 1000.0, 1e6, 0.0), {}),
        (Optics((1920, 1080), 1000.0, 0.0, -1e9), {}),
        (Optics((1920, 1080), 2e6), {}),
        (Optics((1920, 1080), 9.0), {}),
        (WIDE, {"pan_deg": 170.0}),
        (WIDE, {"tilt_deg": 90.0}),
        (WIDE, {"pan_deg": 85.0, "roll_deg": 170.0}),
        (Optics((2, 2), 2.0), {}),
    ],
)
def test_any_lens_and_any_turn_gives_a_picture(optics: Optics, turn: dict[str, float]) -> None:
    room = build_room(RoomKind.LIGHT)
    width, height = optics.image_size
    assert render_real(View(optics, PIVOT_M, **turn), room, 0.6).shape == (height, width, 3)
    assert render_virtual(View(optics, PIVOT_M, **turn), room).shape == (height, width, 3)


def test_pixels_that_no_ray_reaches_are_black() -> None:
    folded = Optics((1920, 1080), 1000.0, -0.9, 0.0)
    picture = render_real(View(folded, PIVOT_M), build_room(), 0.6)
    assert not picture[0, 0].any()
    assert picture[540, 960].any()


def test_a_picture_does_not_depend_on_the_one_before() -> None:
    room = build_room()
    for optics in (WIDE, TELE):
        view = View(optics, PIVOT_M, -2.0, 0.5)
        first = render_real(view, room, 0.6)
        white = np.full_like(first, 255)
        render_virtual(View(WIDE, PIVOT_M, 20.0, 5.0, 30.0), room, over=white)
        assert np.array_equal(render_real(view, room, 0.6), first)
        render_virtual(view, room, over=white)
        assert render_virtual(view, room).min() == 0


def test_a_target_beside_the_picture_leaves_no_trace_in_its_outermost_columns() -> None:
    square = Panel("square", (1, 1), (0.6, 0.6), ((34, 28, 196), (34, 28, 196)), (0.0, 5.0, 1.6))
    room = Room(RoomKind.SQUARE, (square,), (), ())
    optics = Optics((1920, 1080), 5000.0)
    sigma_px = float(np.sqrt(VIRTUAL_BLUR_PX**2 + PIXEL_APERTURE_VARIANCE))
    # Turns at which OpenCV's polygons fill pixels that they should not.
    for turn in ((12.86, 2.66, -44.8), (-12.99, -2.5, -17.7)):
        view = View(optics, PIVOT_M, *turn)
        picture = render_virtual(view, room)
        for column, inward in ((0, 1), (1919, 1918)):
            step = np.abs(picture[:, column].astype(int) - picture[:, inward]).max(axis=1)
            rows = np.argsort(step)[-12:]
            pixels = np.column_stack([np.full(len(rows), column), rows])
            expected = code(brute_force(view, room, sigma_px, pixels).astype(np.float32)).astype(int)
            assert np.abs(picture[rows, column].astype(int) - expected).max() <= 3
