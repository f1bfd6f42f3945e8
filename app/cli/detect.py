"""``lensmatch detect``: a target in one picture, measured to sub-pixel."""

from __future__ import annotations

import asyncio
import math
import re
import time
from pathlib import Path
from typing import Annotated, Any, NoReturn

import numpy as np
import typer

from app.cli.console import EXIT_FAILED, check_out, fail, print_json, reported_errors, results, write_file, wrong_usage
from app.cli.tables import plain_table, print_table
from app.documents import DocumentError
from calibration.detect.target import find_target
from calibration.errors import CalibrationError, InvalidInput
from calibration.image import Transfer, decode_picture
from calibration.types import Detection, Picture, Target, TargetKind
from engine_adapters.errors import AdapterError
from engine_adapters.folder import FolderPictures

import cv2  # isort: skip  (calibration.image sets OpenCV's bound on picture sizes before its first import)

_BOARD = re.compile(r"chessboard:([0-9]{1,4})[xX]([0-9]{1,4})")
_PLACEHOLDER_M = 1.0
# Where a target is in the picture does not depend on its size in metres.


def detect(
    picture: Annotated[Path, typer.Argument(metavar="PICTURE", help="PNG, JPEG or BMP file")],
    target: Annotated[
        str, typer.Option(metavar="SPEC", help="chessboard:COLSxROWS (squares, not inner corners), square or light")
    ],
    transfer: Annotated[
        Transfer | None, typer.Option(help="how light is coded [default: srgb for JPEG files, bt709 for others]")
    ] = None,
    picture_out: Annotated[Path | None, typer.Option(help="PNG to write, with the points drawn in")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON document on standard output")] = False,
) -> None:
    """Find a target in a picture: its points in px with covariance, blur and quality."""
    light = transfer or (Transfer.SRGB if picture.suffix.lower() in (".jpg", ".jpeg") else Transfer.BT709)
    with reported_errors(as_json):
        wanted = _target(target)
        check_out(picture_out)
        try:
            pixels = _read(picture)
        except DocumentError as error:
            _not_found(str(error), as_json)
        started = time.perf_counter()
        found = find_target(pixels, wanted, transfer=light)
        seconds = time.perf_counter() - started
        if not isinstance(found, Detection):
            _not_found(found.reason, as_json)
        if picture_out is not None:
            write_file(picture_out, _drawn(pixels, found))
        if as_json:
            print_json(_document(found, seconds))
        else:
            _show(found, wanted, seconds)


def _target(spec: str) -> Target:
    """The target that SPEC names; exits with 2 for one that is none."""
    try:
        if spec == "square":
            return Target(TargetKind.SQUARE, size_m=(_PLACEHOLDER_M, _PLACEHOLDER_M))
        if spec == "light":
            return Target(TargetKind.LIGHT, diameter_m=_PLACEHOLDER_M)
        if match := _BOARD.fullmatch(spec):
            return Target(TargetKind.CHESSBOARD, squares=(int(match[1]), int(match[2])), square_m=_PLACEHOLDER_M)
    except InvalidInput as error:
        wrong_usage(f"--target {spec}: {error}")
    wrong_usage(f"--target {spec}: write chessboard:COLSxROWS (squares), as in chessboard:10x7, or square, or light")


def _read(path: Path) -> Picture:
    whole = path.resolve()
    try:
        frame = asyncio.run(FolderPictures(whole.parent).read(whole.name))
        return decode_picture(frame.data)
    except (AdapterError, CalibrationError) as error:
        told = str(error).removeprefix(f"{whole.name}: ").removeprefix(f"{whole.parent}: ")
        raise DocumentError(f"{path}: {told}") from error


def _not_found(reason: str, as_json: bool) -> NoReturn:
    if as_json:
        print_json({"found": False, "reason": reason, "error": f"not found: {reason}"})
        raise typer.Exit(EXIT_FAILED)
    fail(f"not found: {reason}", EXIT_FAILED)


def _document(found: Detection, seconds: float) -> dict[str, Any]:
    quality = found.quality
    return {
        "found": True,
        "kind": found.kind.value,
        "points": found.points_px.tolist(),
        "point_ids": found.point_ids.tolist(),
        "covariance": found.covariance_px2.tolist(),
        "centre": found.centre_px.tolist(),
        "blur_px": _told(found.blur_px),
        "quality": {
            "score": _told(quality.score),
            "contrast": _told(quality.contrast),
            "fit_chi2": _told(quality.fit_chi2),
            "grid_rms_px": _told(quality.grid_rms_px),
        },
        "seconds": seconds,
    }


def _told(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _show(found: Detection, wanted: Target, seconds: float) -> None:
    columns = wanted.grid[0]
    table = plain_table("points in px, pixel centres at whole numbers", ("column", "row", "u", "v", "sigma u", "v"))
    sigmas = np.sqrt(np.maximum(np.diagonal(found.covariance_px2, axis1=1, axis2=2), 0.0))
    for number, (u, v), (sigma_u, sigma_v) in zip(found.point_ids, found.points_px, sigmas, strict=True):
        row, column = divmod(int(number), columns)
        table.add_row(str(column), str(row), f"{u:.4f}", f"{v:.4f}", f"{sigma_u:.4f}", f"{sigma_v:.4f}")
    print_table(table)
    blur = "not told" if math.isnan(found.blur_px) else f"{found.blur_px:.2f} px"
    results.print(
        f"{len(found.points_px)} of {len(wanted.points_m())} points, centre ({found.centre_px[0]:.3f}, "
        f"{found.centre_px[1]:.3f}), blur {blur}, quality {found.quality.score:.2f}, {1000 * seconds:.0f} ms"
    )


def _drawn(pixels: Picture, found: Detection) -> bytes:
    """The picture with a cross at each point and a ring around the first one, as PNG."""
    canvas = pixels.copy()
    size = max(6, round(min(pixels.shape[:2]) / 100))
    places = [(round(float(u)), round(float(v))) for u, v in found.points_px]
    for place in places:
        cv2.drawMarker(canvas, place, (0, 0, 0), cv2.MARKER_CROSS, size, 3)
        cv2.drawMarker(canvas, place, (0, 255, 0), cv2.MARKER_CROSS, size, 1)
    cv2.circle(canvas, places[0], size, (255, 128, 0), 2)
    done, data = cv2.imencode(".png", canvas)
    if not done:
        raise InvalidInput("picture", f"{canvas.shape}", "the picture cannot be written as PNG")
    return bytes(data)
