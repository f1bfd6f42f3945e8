"""mrcal on the corners of one case: a process of its own, for the interpreter that mrcal is installed in.

``python mrcal_process.py CORNERS.npz`` prints one JSON object. The file holds ``observations`` (V, rows, columns, 3):
px and weight (0 or less: not seen), ``spacing_m``, ``image_size``, ``repeats`` and ``held_out`` (whether each view is
also left out in turn). The way is that of mrcal-calibrate-cameras: a stereographic seed, then the focal length and the
poses, then everything with the board's warp and mrcal's own rejection of outliers.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from typing import Any

import numpy as np

MODEL = "LENSMODEL_OPENCV4"


def solve(mrcal: Any, observations: Any, spacing_m: float, size: tuple[int, int]) -> dict[str, Any]:
    """One calibration of the views given."""
    rows, columns = observations.shape[1:3]
    count = len(observations)
    width, height = size
    seed, _, frames = mrcal.seed_stereographic(
        imagersizes=((width, height),),
        focal_estimate=float(width),
        indices_frame_camera=np.array([[i, 0] for i in range(count)], dtype=np.int32),
        observations=observations.copy(),
        object_spacing=spacing_m,
    )
    asked: dict[str, Any] = {
        "intrinsics": np.concatenate([np.asarray(seed)[:, :4], np.zeros((1, 4))], axis=1),
        "extrinsics_rt_fromref": np.zeros((0, 6)),
        "frames_rt_toref": np.ascontiguousarray(frames),
        "points": None,
        "observations_board": observations.copy(),
        "indices_frame_camintrinsics_camextrinsics": np.array([[i, 0, -1] for i in range(count)], dtype=np.int32),
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "lensmodel": MODEL,
        "calobject_warp": np.zeros(2),
        "imagersizes": np.array([[width, height]], dtype=np.int32),
        "calibration_object_spacing": spacing_m,
        "do_apply_regularization": True,
        "verbose": False,
    }
    mrcal.optimize(
        **asked,
        do_optimize_intrinsics_core=True,
        do_optimize_intrinsics_distortions=False,
        do_optimize_calobject_warp=False,
        do_apply_outlier_rejection=False,
    )
    stats = mrcal.optimize(
        **asked,
        do_optimize_intrinsics_core=True,
        do_optimize_intrinsics_distortions=True,
        do_optimize_calobject_warp=True,
        do_apply_outlier_rejection=True,
    )
    counted = asked["observations_board"][..., 2] > 0
    seen = observations[..., 2] > 0
    residual = np.asarray(stats["x"])[: 2 * rows * columns * count].reshape(count, rows, columns, 2)[counted]
    return {
        "intrinsics": asked["intrinsics"][0].tolist(),
        "warp_m": asked["calobject_warp"].tolist(),
        "rms_px": float(np.sqrt(np.mean(residual**2))),
        "outliers": 1 - float(counted.sum() / seen.sum()),
    }


def main(path: str) -> dict[str, Any]:
    """What the process prints: the calibration, its time, and the calibrations without one view each."""
    try:
        mrcal = importlib.import_module("mrcal")  # no dependency of ours: it comes with this process' interpreter
    except ImportError:
        return {"problem": "not installed"}
    given = np.load(path)
    observations, size = given["observations"].astype(np.float64), tuple(int(side) for side in given["image_size"])
    spacing_m = float(given["spacing_m"])
    times = []
    found: dict[str, Any] = {}
    for _ in range(int(given["repeats"])):
        started = time.process_time()
        found = solve(mrcal, observations, spacing_m, (size[0], size[1]))
        times.append(time.process_time() - started)
    found["cpu_ms"] = 1e3 * min(times)
    if given["held_out"]:
        found["without"] = [
            solve(mrcal, np.delete(observations, index, axis=0), spacing_m, (size[0], size[1]))
            for index in range(len(observations))
        ]
    return found


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1])))
