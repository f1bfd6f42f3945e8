"""Where the iteration of a level starts: a focal length, and a pose for each picture that has none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.camera import rays_of, target_points_world, world_to_camera
from calibration.errors import NotEnoughData
from calibration.lens import Lens
from calibration.solve.geometry import target_points
from calibration.solve.problem import FreePoses, View
from calibration.solve.rotation import cross
from calibration.types import FloatArray, IntArray

_FOVS_DEG = (120.0, 95.0, 75.0, 60.0, 48.0, 38.0, 30.0, 22.0, 15.0, 9.0, 5.0, 3.0)
_K1_HW = (-0.15, -0.05, 0.0, 0.05)
_SHORTEST_F, _LONGEST_F = 0.2, 40.0
# Focal lengths over the picture's width: fields of view of 136 and 1.4 degrees.
# Coarse steps over all lenses that make pictures: the iteration converges from the nearest by far.


def start(
    views: Sequence[View],
    image_size: tuple[int, int],
    pixel_aspect: float,
    nodal_offset_mm: float,
    guess: Lens | None = None,
    *,
    thorough: bool = False,
) -> tuple[Lens, FreePoses]:
    """A lens and the free poses to start from.

    With known poses every ray is known and u = f x + cx is linear in (f, cx, cy); otherwise the focal length
    follows from the homographies, or, ``thorough``, it and the sign of the distortion are tried in coarse steps, each
    with the poses that fit it best.
    """
    free = {i: v for i, v in enumerate(views) if v.free}
    if guess is not None:
        return guess, _poses(free, guess)[0]
    if len(free) < len(views):
        lens = _from_known_rays([v for v in views if not v.free], image_size, pixel_aspect, nodal_offset_mm)
        return lens, _poses(free, lens)[0]
    quick = None if thorough else _from_homographies(views, image_size, pixel_aspect, nodal_offset_mm)
    if quick is not None:
        return quick, _poses(free, quick)[0]
    best: tuple[float, Lens, FreePoses] | None = None
    for fov in _FOVS_DEG:
        for k1_hw in _K1_HW:
            straight = Lens.from_fov(image_size, fov, pixel_aspect=pixel_aspect, nodal_offset_mm=nodal_offset_mm)
            lens = straight.with_hw(straight.f_px, k1_hw, 0.0)
            poses, error = _poses(free, lens)
            if best is None or error < best[0]:
                best = error, lens, poses
    if best is None or not math.isfinite(best[0]):
        raise NotEnoughData("no pose explains any picture; check the target's size and its squares")
    return best[1], best[2]


def _from_homographies(
    views: Sequence[View], image_size: tuple[int, int], pixel_aspect: float, nodal_offset_mm: float
) -> Lens | None:
    """A focal length from the pictures alone, the principal point in the middle and no distortion; None if untold.

    A plane's homography H = [h1 h2 h3] gives two equations linear in 1 / f^2 (Zhang, PAMI 22, 2000), with x, y counted
    from the middle: h1'h2 = 0 and h1'h1 = h2'h2 in the metric diag(1/f^2, 1/f^2, 1). The weighted median of their
    solutions is not led astray by the pictures in which the board faces the camera.
    """
    middle = (np.asarray(image_size, dtype=np.float64) - 1) / 2
    squares: list[tuple[float, float]] = []
    seen = [view for view in views if len(view.detection.points_px) >= 4]
    if not seen:
        return None
    board = _Boards.of(seen)
    pixels = (board.pixels - middle) / [1.0, pixel_aspect] / image_size[0]
    size = [max(view.target.outline_m()) for view in seen]
    for H in board.homographies(pixels) * np.reshape(size, (-1, 1, 1)):
        (a, b), (c, d), (e, f) = H[:, :2]
        for numerator, denominator in ((a * b + c * d, -e * f), (a * a + c * c - b * b - d * d, f * f - e * e)):
            if numerator * denominator > 0:
                squares.append((float(numerator / denominator), float(abs(denominator))))
    if not squares:
        return None
    squares.sort()
    weights = np.cumsum([weight for _, weight in squares])
    f_px = math.sqrt(squares[int(np.searchsorted(weights, weights[-1] / 2))][0]) * image_size[0]
    if not _SHORTEST_F < f_px / image_size[0] < _LONGEST_F:
        return None
    return Lens(image_size, f_px, pixel_aspect=pixel_aspect, nodal_offset_mm=nodal_offset_mm)


def _from_known_rays(
    views: Sequence[View], image_size: tuple[int, int], pixel_aspect: float, nodal_offset_mm: float
) -> Lens:
    width, height = image_size
    worlds: dict[int, FloatArray] = {}
    rows: list[FloatArray] = []
    values: list[FloatArray] = []
    for view in views:
        if view.camera_pose is None or view.target.pose is None:
            continue
        if id(view.target) not in worlds:
            worlds[id(view.target)] = target_points_world(view.target.pose, view.target.points_m())
        world = worlds[id(view.target)][view.detection.point_ids]
        rays = rays_of(world_to_camera(view.camera_pose, nodal_offset_mm, world))
        ones, zeros = np.ones(len(rays)), np.zeros(len(rays))
        rows.append(np.column_stack([rays[:, 0], ones, zeros]))
        values.append(view.detection.points_px[:, 0] - (width - 1) / 2)
        rows.append(np.column_stack([pixel_aspect * rays[:, 1], zeros, ones]))
        values.append(view.detection.points_px[:, 1] - (height - 1) / 2)
    matrix, right = np.concatenate(rows), np.concatenate(values)
    usable = np.isfinite(matrix).all(axis=1)
    if usable.sum() < 6:
        raise NotEnoughData(
            "the target is behind the camera in every picture; check its pose and the head's angles (pan is positive "
            "to the right, tilt upwards)"
        )
    # The centre is only loosely free at the start: with few points it trades against the focal length.
    hold = np.diag([0.0, 1e-2, 1e-2])
    matrix, right = matrix[usable], right[usable]
    f_px, shift_x, shift_y = np.linalg.solve(matrix.T @ matrix + hold, matrix.T @ right)
    if not f_px > 0:
        raise NotEnoughData(
            "the pictures contradict the poses (the target moves the wrong way); check the signs of pan and tilt"
        )
    return Lens(
        image_size,
        float(f_px),
        center_shift_px=(float(shift_x), float(shift_y)),
        pixel_aspect=pixel_aspect,
        nodal_offset_mm=nodal_offset_mm,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Boards:
    """All points of some views: ``plane`` (N, 2) metres, ``pixels`` (N, 2), those of view v from ``first[v]`` on;
    ``view_of`` (N,)."""

    plane: FloatArray
    pixels: FloatArray
    first: IntArray
    view_of: IntArray

    @classmethod
    def of(cls, views: Sequence[View]) -> _Boards:
        counts = np.array([len(v.detection.points_px) for v in views])
        plane = target_points(views)
        pixels = np.concatenate([v.detection.points_px for v in views])
        return cls(plane, pixels, np.cumsum(counts) - counts, np.repeat(np.arange(len(views)), counts))

    def homographies(self, image: FloatArray) -> FloatArray:
        """(V, 3, 3) from the board's plane to ``image`` (N, 2), which looks at its points from in front (h33 > 0 at
        their middle); scaled so that it carries the middle with depth 1.

        The normalised linear solution (Hartley and Zisserman, Multiple view geometry, 4.4) of all views at once: the
        eigenvector of the least eigenvalue of each view's 9 x 9 matrix.
        """
        (x, y), to_plane = self._normalised(self.plane)
        (u, v), to_image = self._normalised(image)
        products = np.stack([x * x, x * y, x, y * y, y, np.ones_like(x)])
        weighted = np.concatenate([products, u * products, v * products, (u * u + v * v) * products])
        sums = np.add.reduceat(weighted, self.first, axis=1).T.reshape(-1, 4, 6)
        blocks = sums[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 4, 3, 3)
        matrix = np.zeros((len(blocks), 9, 9))
        matrix[:, :3, :3] = matrix[:, 3:6, 3:6] = blocks[:, 0]
        matrix[:, :3, 6:] = matrix[:, 6:, :3] = -blocks[:, 1]
        matrix[:, 3:6, 6:] = matrix[:, 6:, 3:6] = -blocks[:, 2]
        matrix[:, 6:, 6:] = blocks[:, 3]
        H = np.linalg.eigh(matrix)[1][:, :, 0].reshape(-1, 3, 3)
        H = H / np.where(np.abs(H[:, 2:, 2:]) > 1e-12, H[:, 2:, 2:], np.nan)
        return np.asarray(np.linalg.inv(to_image) @ H @ to_plane)

    def _normalised(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (2, N) with each view's mean at 0 and a mean square of 1, and the matrices (V, 3, 3) that do it."""
        counts = np.diff(np.append(self.first, len(points)))[:, None]
        mean = np.add.reduceat(points, self.first, axis=0) / counts
        off = points - mean[self.view_of]
        spread = np.sqrt(np.add.reduceat(off**2, self.first, axis=0).sum(axis=1) / (2 * counts[:, 0]))
        scale = 1 / np.maximum(spread, 1e-300)
        matrix = np.zeros((len(scale), 3, 3))
        matrix[:, 0, 0] = matrix[:, 1, 1] = scale
        matrix[:, :2, 2], matrix[:, 2, 2] = -scale[:, None] * mean, 1.0
        return (off * scale[self.view_of, None]).T, matrix


def _poses(free: dict[int, View], lens: Lens) -> tuple[FreePoses, float]:
    """Camera-from-target poses for ``lens`` and the RMS distance in px that they leave (infinite if none fits).

    The nearest rotation to each homography's first two columns, and its mirror image along the line of sight: a board
    without visible perspective looks the same either way, so the better of the two counts.
    """
    if not free:
        return {}, 0.0
    views = [*free.values()]
    if min(len(view.detection.points_px) for view in views) < 4:
        return _fallback(free, lens), math.inf
    board = _Boards.of(views)
    rays = lens.unproject(board.pixels)
    if not np.isfinite(rays).all():
        return _fallback(free, lens), math.inf
    H = board.homographies(rays)
    if not np.isfinite(H).all():
        return _fallback(free, lens), math.inf
    scale = np.linalg.norm(H[:, :, :2], axis=1).mean(axis=1)[:, None, None]
    left, _, right = np.linalg.svd(H[:, :, :2] / scale, full_matrices=False)
    first_two, t = left @ right, H[:, :, 2] / scale[:, :, 0]
    middle = np.add.reduceat(board.plane, board.first, axis=0)
    middle /= np.diff(np.append(board.first, len(board.plane)))[:, None]
    centre = np.einsum("vij,vj->vi", first_two, middle) + t
    sight = centre / np.linalg.norm(centre, axis=1, keepdims=True)
    other = first_two - 2 * sight[:, :, None] * np.einsum("vi,vij->vj", sight, first_two)[:, None, :]
    candidates = (first_two, t), (other, centre - np.einsum("vij,vj->vi", other, middle))
    squares = []
    for columns, shift in candidates:
        points = np.einsum("nij,nj->ni", columns[board.view_of], board.plane) + shift[board.view_of]
        distance = np.sum((lens.project(rays_of(points)) - board.pixels) ** 2, axis=1)
        squares.append(np.add.reduceat(np.where(np.isfinite(distance), distance, np.inf), board.first))
    mirrored = squares[1] < squares[0]
    least = np.minimum(squares[0], squares[1])
    if not np.isfinite(least).all():
        return _fallback(free, lens), math.inf
    columns = np.where(mirrored[:, None, None], other, first_two)
    shift = np.where(mirrored[:, None], candidates[1][1], t)
    R = np.concatenate([columns, cross(columns[:, :, 0], columns[:, :, 1])[:, :, None]], axis=2)
    poses = {index: (R[place], shift[place]) for place, index in enumerate(free)}
    return poses, math.sqrt(float(least.sum()) / len(board.pixels))


def _fallback(free: dict[int, View], lens: Lens) -> FreePoses:
    """Poses straight in front, at the distance that the target's size tells."""
    poses: FreePoses = {}
    for index, view in free.items():
        spread_px = float(np.ptp(view.detection.points_px, axis=0).max())
        distance_m = lens.f_px * max(view.target.outline_m()) / max(spread_px, 1.0)
        centre = (view.detection.points_px.mean(axis=0) - np.asarray(lens.principal_point_px)) / lens.f_px
        poses[index] = np.eye(3), np.array([centre[0], centre[1], 1.0]) * distance_m
    return poses
