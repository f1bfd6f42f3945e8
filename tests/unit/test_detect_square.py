"""The plain square: which thing is it, where are its corners, and is the covariance true.

The pictures of the first part are drawn here, by another road than the detector's model: an analytic Gaussian edge for
each side in the undistorted plane, multiplied, coded by BT.709 with seeded noise.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr

from calibration.detect.prediction import Prediction
from calibration.detect.square import find_square
from calibration.errors import InvalidInput
from calibration.image import Transfer, decode_picture
from calibration.types import Detection, Refusal, Target, TargetKind

Floats = NDArray[np.float64]

RED = (0.02, 0.018, 0.55)
DULL_RED = (0.016, 0.014, 0.2)
PINK = (0.19, 0.10, 0.55)
GREEN = (0.05, 0.3, 0.06)
ROW_BY_ROW = [0, 1, 3, 2]
SQUARE = Target(TargetKind.SQUARE, size_m=(0.6, 0.6), colours=("red",))


def bt709(light: Floats) -> Floats:
    light = np.clip(light, 0, 1)
    coded: Floats = 255 * np.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099)
    return coded


class Scene:
    """A picture built up in linear light, with one radial term of distortion about its centre."""

    def __init__(
        self, width: int, height: int, background: tuple[float, float, float] = GREEN, k1: float = 0.0
    ) -> None:
        self.size = (width, height)
        self.focal_px = float(width)
        self.k1 = k1
        self.light = np.ones((height, width, 3)) * np.array(background)
        v, u = np.mgrid[:height, :width].astype(np.float64)
        self.plane = self._undistorted(np.stack([u, v], axis=-1))

    def _centre(self) -> Floats:
        return (np.array(self.size, dtype=np.float64) - 1) / 2

    def _undistorted(self, place: Floats) -> Floats:
        q = (place - self._centre()) / self.focal_px
        x = q.copy()
        for _ in range(40 if self.k1 else 0):
            x = q / (1 + self.k1 * np.sum(x**2, axis=-1, keepdims=True))
        return np.asarray(self._centre() + self.focal_px * x)

    def distorted(self, place: Floats) -> Floats:
        x = (place - self._centre()) / self.focal_px
        return np.asarray(self._centre() + self.focal_px * x * (1 + self.k1 * np.sum(x**2, axis=-1, keepdims=True)))

    def fill(self, corners: Floats, colour: tuple[float, float, float], sigma_px: float = 0.5) -> Floats:
        """Paint a convex polygon given clockwise in the undistorted plane; returns its corners in the picture."""
        self.light += self.share(corners, sigma_px)[..., None] * (np.array(colour) - self.light)
        return self.distorted(corners)

    def share(self, corners: Floats, sigma_px: float = 0.5) -> Floats:
        """Share (H, W) of each pixel that a convex polygon covers."""
        share = np.ones(self.light.shape[:2])
        for first, second in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            along = (second - first) / np.linalg.norm(second - first)
            depth = (self.plane - first) @ np.array([-along[1], along[0]])
            down, across = np.gradient(depth)
            share *= ndtr(depth / np.hypot(across, down) / sigma_px)
        return np.asarray(share)

    def disk(self, centre: tuple[float, float], radius: float, colour: tuple[float, float, float]) -> None:
        v, u = np.mgrid[: self.size[1], : self.size[0]]
        share = ndtr((radius - np.hypot(u - centre[0], v - centre[1])) / 0.5)
        self.light += share[..., None] * (np.array(colour) - self.light)

    def picture(self, noise: float = 2.0, seed: int = 1) -> NDArray[np.uint8]:
        coded = bt709(self.light) + np.random.default_rng(seed).normal(0, noise, self.light.shape)
        return np.asarray(np.clip(np.rint(coded), 0, 255), dtype=np.uint8)


def square_at(u: float, v: float, side: float, roll_deg: float = 0.0, height: float = 1.0) -> Floats:
    a = math.radians(roll_deg)
    turn = np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    unit = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) / 2
    return np.asarray((unit * [side, side * height]) @ turn.T + [u, v])


def found(result: object) -> Detection:
    assert isinstance(result, Detection), result
    return result


def off(detection: Detection, clockwise: Floats) -> Floats:
    return np.asarray(detection.points_px - clockwise[ROW_BY_ROW])


@pytest.mark.parametrize("roll_deg", [-44.0, -20.0, 0.0, 7.0, 44.0])
def test_order_is_upright_and_row_by_row(roll_deg: float) -> None:
    scene = Scene(400, 300)
    corners = scene.fill(square_at(210, 140, 110, roll_deg), RED)
    detection = found(find_square(scene.picture(), SQUARE))
    assert np.abs(off(detection, corners)).max() < 0.06
    assert detection.point_ids.tolist() == [0, 1, 2, 3]
    assert detection.kind is TargetKind.SQUARE
    assert detection.centre_px == pytest.approx([210, 140], abs=0.05)


@pytest.mark.parametrize(
    ("side", "sigma_px", "noise", "roll_deg", "k1", "most_rms"),
    [
        (120, 0.5, 2.0, 3.0, 0.0, 0.012),
        (120, 3.0, 2.0, 5.0, 0.0, 0.035),
        (14, 0.6, 2.0, 5.0, 0.0, 0.03),
        (60, 5.0, 2.0, 10.0, 0.0, 0.09),
        (120, 0.6, 8.0, 30.0, 0.0, 0.045),
        (200, 0.6, 2.0, 2.0, -0.2, 0.012),
    ],
)
def test_corners_and_their_covariance(
    side: float, sigma_px: float, noise: float, roll_deg: float, k1: float, most_rms: float
) -> None:
    """Errors are small, and as large as the covariance says: normalised squared errors average at most 1 or so."""
    errors, normalised, blurs = [], [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        scene = Scene(280, 240, k1=k1)
        u, v = np.array([140.0, 120.0]) + rng.uniform(-0.5, 0.5, 2)
        corners = scene.fill(square_at(u, v, side, roll_deg + rng.uniform(-1, 1)), RED, sigma_px)
        detection = found(find_square(scene.picture(noise, seed), SQUARE))
        error = off(detection, corners)
        errors.append(error)
        blurs.append(detection.blur_px)
        inverse = np.linalg.inv(detection.covariance_px2)
        normalised.extend(np.einsum("ni,nij,nj->n", error, inverse, error) / 2)
    assert np.sqrt(np.mean(np.square(errors))) < most_rms
    # 24 corners, two coordinates each: sigma of the mean is 0.2 if the covariance is right. The floor for what a real
    # pixel response leaves makes sharp pictures look better than stated, never worse.
    assert 0.02 < np.mean(normalised) < 1.6
    assert np.mean(blurs) == pytest.approx(math.sqrt(sigma_px**2 - 1 / 12), rel=0.02, abs=0.02)


def test_linear_light_is_needed() -> None:
    """On coded values the same edges stand too far out: the setting does something, and the right one is right."""
    scene = Scene(320, 260, background=(0.01, 0.012, 0.01))
    corners = scene.fill(square_at(160.3, 130.2, 120, 4.0), RED, 1.5)
    picture = scene.picture(0.5)
    right = off(found(find_square(picture, SQUARE)), corners)
    wrong = off(found(find_square(picture, SQUARE, transfer=Transfer.LINEAR)), corners)
    assert np.abs(right).max() < 0.04
    assert np.abs(wrong).max() > 0.1


def test_background_that_changes_along_a_side() -> None:
    scene = Scene(480, 360)
    target = square_at(250, 180, 150, 2.0)
    scene.fill(square_at(170, 190, 120), (0.01, 0.01, 0.01))
    scene.fill(square_at(170, 190, 100), PINK)
    scene.fill(square_at(250, 300, 14, 0, 14), (0.02, 0.02, 0.02))
    corners = scene.fill(target, RED)
    detection = found(find_square(scene.picture(), SQUARE))
    assert np.abs(off(detection, corners)).max() < 0.05


def test_wins_among_reddish_things() -> None:
    scene = Scene(960, 540)
    scene.fill(square_at(120, 420, 90, 0, 2.2), (0.02, 0.01, 0.35))  # pillar
    scene.fill(square_at(760, 300, 120, 20), DULL_RED)  # tilted, dull, larger
    scene.fill(square_at(300, 120, 130, 0, 0.3), (0.25, 0.3, 0.65))  # salmon
    scene.disk((620, 430), 45, (0.02, 0.02, 0.5))  # ball
    scene.fill(square_at(880, 90, 100, 0, 0.45), (0.03, 0.03, 0.9))  # sign
    corners = scene.fill(square_at(450, 280, 100, 3), RED)
    detection = found(find_square(scene.picture(), SQUARE))
    assert np.abs(off(detection, corners)).max() < 0.05


@pytest.mark.parametrize("exposure", [0.05, 0.3, 1.5])
def test_lamp_level_does_not_matter(exposure: float) -> None:
    scene = Scene(400, 300)
    corners = scene.fill(square_at(200, 150, 100, 4), RED)
    scene.light *= exposure
    detection = found(find_square(scene.picture(1.5), SQUARE))
    assert np.abs(off(detection, corners)).max() < 0.15


@pytest.mark.parametrize("lit", [0.35, 0.5, 0.7, 0.85])
@pytest.mark.parametrize("left", [0.25, 0.5])
def test_shadow_across_it(lit: float, left: float) -> None:
    """The lit part has straight sides too, and more light than the whole."""
    scene = Scene(480, 360)
    corners = scene.fill(square_at(240, 180, 120, 3), RED)
    edge = 240 + 120 * (0.5 - lit)
    across = np.arange(480) - edge
    scene.light *= (left + (1 - left) * ndtr(across / 1.5))[None, :, None]
    assert np.abs(off(found(find_square(scene.picture(), SQUARE)), corners)).max() < 0.06


def test_two_equal_squares_are_refused_unless_one_is_expected() -> None:
    scene = Scene(640, 360)
    one = scene.fill(square_at(160, 180, 110), RED)
    two = scene.fill(square_at(460, 180, 105, 5), RED)
    picture = scene.picture()
    result = find_square(picture, SQUARE)
    assert isinstance(result, Refusal)
    assert "equally" in result.reason
    for corners in (one, two):
        near = Prediction(corners[ROW_BY_ROW] + 3.0, 4.0)
        assert np.abs(off(found(find_square(picture, SQUARE, near=near)), corners)).max() < 0.05


def test_prediction_elsewhere_is_refused() -> None:
    scene = Scene(640, 360)
    corners = scene.fill(square_at(160, 180, 110), RED)
    result = find_square(scene.picture(), SQUARE, near=Prediction(corners[ROW_BY_ROW] + [250.0, 0.0], 4.0))
    assert isinstance(result, Refusal)
    outside = find_square(scene.picture(), SQUARE, near=Prediction(corners[ROW_BY_ROW] + [5000.0, 0.0], 4.0))
    assert isinstance(outside, Refusal)
    assert "outside" in outside.reason


def test_cut_square_is_not_replaced_by_a_decoy() -> None:
    scene = Scene(640, 360)
    scene.fill(square_at(610, 180, 130), RED)
    scene.fill(square_at(250, 180, 80, 20), DULL_RED)
    result = find_square(scene.picture(), SQUARE)
    assert isinstance(result, Refusal)
    assert "cut by" in result.reason


@pytest.mark.parametrize("shape", ["nothing", "disk", "bar", "tiny"])
def test_what_is_no_square_is_refused(shape: str) -> None:
    scene = Scene(480, 360)
    if shape == "disk":
        scene.disk((240, 180), 60, RED)
    elif shape == "bar":
        scene.fill(square_at(240, 180, 200, 0, 0.3), RED)
    elif shape == "tiny":
        scene.fill(square_at(240, 180, 7), RED)
    assert isinstance(find_square(scene.picture(), SQUARE), Refusal)


@pytest.mark.parametrize(
    ("colour", "inside", "background"),
    [
        ("green", (0.05, 0.45, 0.06), (0.2, 0.2, 0.2)),
        ("blue", (0.5, 0.05, 0.03), (0.2, 0.2, 0.2)),
        ("white", (0.8, 0.8, 0.8), (0.1, 0.1, 0.1)),
        ("black", (0.01, 0.01, 0.01), (0.4, 0.4, 0.4)),
    ],
)
def test_other_colours(colour: str, inside: tuple[float, float, float], background: tuple[float, float, float]) -> None:
    scene = Scene(400, 300, background)
    corners = scene.fill(square_at(200, 150, 100, 4), inside)
    target = Target(TargetKind.SQUARE, size_m=(0.6, 0.6), colours=(colour,))
    assert np.abs(off(found(find_square(scene.picture(), target)), corners)).max() < 0.06


def test_small_square_in_a_large_picture() -> None:
    """The rough search works on a reduced picture: a side of 14 px is still seen there."""
    scene = Scene(1920, 1080)
    corners = scene.fill(square_at(1300.3, 420.7, 14, 8), RED)
    assert np.abs(off(found(find_square(scene.picture(), SQUARE)), corners)).max() < 0.12


def test_underexposed_tie_is_no_choice() -> None:
    """Where hardly any light is left the target still wins over a decoy, or nothing does."""
    scene = Scene(640, 360)
    corners = scene.fill(square_at(160, 180, 110), RED)
    scene.fill(square_at(460, 180, 120, 20), DULL_RED)
    scene.light *= 0.02
    result = find_square(scene.picture(1.5), SQUARE)
    assert isinstance(result, Refusal) or np.abs(off(result, corners)).max() < 1.0


def test_proportions_of_the_target_are_used() -> None:
    scene = Scene(640, 360)
    scene.fill(square_at(160, 180, 100), RED)
    wide = scene.fill(square_at(440, 180, 180, 3, 0.5), RED)
    target = Target(TargetKind.SQUARE, size_m=(1.0, 0.5), colours=("red",))
    assert np.abs(off(found(find_square(scene.picture(), target)), wide)).max() < 0.05


@pytest.mark.parametrize("corner", [0, 1, 2, 3])
def test_half_hidden_corner_is_where_its_sides_cross(corner: int) -> None:
    """A dark ball covers a corner: it is found all the same, and less certain than the others."""
    scene = Scene(480, 360)
    corners = scene.fill(square_at(240.3, 180.2, 170, 4), RED)
    scene.disk((float(corners[corner, 0]) + 4, float(corners[corner, 1]) - 3), 38, (0.03, 0.03, 0.035))
    detection = found(find_square(scene.picture(), SQUARE))
    error = off(detection, corners)
    assert detection.point_ids.tolist() == [0, 1, 2, 3]
    assert np.abs(error).max() < 0.25
    sigma = np.sqrt(np.trace(detection.covariance_px2, axis1=1, axis2=2))
    hidden = ROW_BY_ROW.index(corner)
    assert int(np.argmax(sigma)) == hidden
    seen = np.delete(error, hidden, axis=0)
    assert np.abs(seen).max() < 0.05
    assert np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(detection.covariance_px2), error)) / 2 < 3


@pytest.mark.parametrize("corners", [3, 5, 6, 7, 8])
def test_other_polygons_are_no_hidden_squares(corners: int) -> None:
    for radius in (70, 110):
        scene = Scene(480, 360)
        angle = 0.1 + np.arange(corners) * 2 * math.pi / corners
        scene.fill(np.column_stack([240 + radius * np.cos(angle), 180 + radius * np.sin(angle)]), RED)
        assert isinstance(find_square(scene.picture(), SQUARE), Refusal)


@pytest.mark.parametrize("radius", [140, 175])
def test_what_hides_too_much_is_refused(radius: int) -> None:
    scene = Scene(480, 360)
    corners = scene.fill(square_at(240.3, 180.2, 170, 4), RED)
    scene.disk((float(corners[1, 0]), float(corners[1, 1])), radius, (0.03, 0.03, 0.035))
    assert isinstance(find_square(scene.picture(), SQUARE), Refusal)


@pytest.mark.parametrize("width_px", [0.8, 1.6, 3.0])
def test_shadow_beside_two_sides(width_px: float) -> None:
    """A dark strip below and left of the square, on a bright panel: the sides are where the colour ends."""
    errors, normalised = [], []
    for seed in range(3):
        scene = Scene(400, 320, background=(0.4, 0.4, 0.4))
        place = np.array([200.0, 160.0]) + np.random.default_rng(seed).uniform(-0.5, 0.5, 2)
        target = square_at(place[0], place[1], 150, 5)
        # Blurred as one picture: the shadow does not shine through the square's blurred edge.
        red = scene.share(target)
        shade = np.maximum(scene.share(target + [-0.7 * width_px, width_px]), red) - red
        scene.light += shade[..., None] * (0.03 - scene.light) + red[..., None] * (np.array(RED) - scene.light)
        corners = scene.distorted(target)
        detection = found(find_square(scene.picture(2.0, seed), SQUARE))
        error = off(detection, corners)
        errors.append(error)
        normalised.extend(np.einsum("ni,nij,nj->n", error, np.linalg.inv(detection.covariance_px2), error) / 2)
    assert np.sqrt(np.mean(np.square(errors))) < 0.05
    assert np.mean(normalised) < 4


def test_bad_input() -> None:
    picture = Scene(64, 48).picture()
    with pytest.raises(InvalidInput):
        find_square(picture, Target(TargetKind.LIGHT))
    with pytest.raises(InvalidInput):
        find_square(picture[:, :, 0], SQUARE)
    unknown = find_square(picture, Target(TargetKind.SQUARE, size_m=(1, 1), colours=("plaid",)))
    assert isinstance(unknown, Refusal)
    assert "plaid" in unknown.reason


RENDERS = [
    ("square_Z0F0", 0.03),
    ("square_Z1F0", 0.03),
    ("square_Z3F1", 0.03),
    ("hard_noise_square_lo", 0.05),
    ("hard_blur_square_coc16", 0.2),
    ("nodal_B", 0.03),
]


@pytest.mark.parametrize(("name", "most_rms"), RENDERS)
def test_renders(shared_data: Path, name: str, most_rms: float) -> None:
    """Pictures of another renderer, with decoys: the right target in each, its corners to hundredths of a pixel."""
    folder = shared_data / "renders" / name
    described = json.loads((folder / "set.json").read_text())
    truth = json.loads((folder / "truth.json").read_text())["pictures"]
    seen = 0
    for entry in described["pictures"]:
        target = described["targets"][entry["target"]]
        if target["kind"] != "square":
            continue
        picture = decode_picture((folder / entry["file"]).read_bytes())
        wanted = Target(TargetKind.SQUARE, size_m=tuple(target["size_m"]), colours=tuple(target["colours"]))
        detection = found(find_square(picture, wanted))
        corners = next(
            np.array(one["outer_corners_tl_tr_br_bl"])
            for one in truth[entry["file"]]
            if one["target"] == entry["target"]
        )
        assert np.sqrt(np.mean(off(detection, corners) ** 2)) < most_rms, entry["file"]
        seen += 1
    assert seen
