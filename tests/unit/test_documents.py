"""Picture sets and jobs: what is refused, in one line that names the field."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from app.documents import DocumentError, read_job, read_picture_set

POSE = {"centre_m": [0.0, 5.0, 1.6]}
BOARD = {"kind": "chessboard", "squares": [8, 8], "square_m": 0.075, "pose": POSE}
SET: dict[str, Any] = {
    "picture_set": 1,
    "image_size": [1920, 1080],
    "pixel_aspect": 1.0,
    "targets": {"board": BOARD},
    "pictures": [{"file": "a.png", "target": "board"}, {"file": "b.png", "target": "board"}],
}
JOB: dict[str, Any] = {
    "job": 1,
    "lens": "XA 20x",
    "levels": [{"zoom": 0.0, "focus": 0.5}],
    "targets": {"board": BOARD},
    "pivot_m": [0.0, 0.0, 1.6],
}

Change = Callable[[dict[str, Any]], object]


def written(folder: Path, name: str, document: dict[str, Any], change: Change) -> Path:
    changed = copy.deepcopy(document)
    change(changed)
    path = folder / name
    path.write_text(json.dumps(changed))
    return path


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda s: s.update(pixel_apsect=1.001), "'pixel_apsect' is not known; is 'pixel_aspect' meant"),
        (lambda s: s["targets"]["board"].update(sqare_m=0.1), "is 'square_m' meant"),
        (lambda s: s["targets"]["board"]["pose"].update(sigma=0.1), "is 'sigma_m' meant"),
        (lambda s: s["pictures"].append({"file": "a.png", "target": "board"}), "a second time"),
        (lambda s: s["pictures"][0].update(target="wall"), "not in targets"),
        (lambda s: s["pictures"][0].update(zoom=2.0), "pictures.0.zoom"),
        (lambda s: s["targets"]["board"]["pose"].update(centre_m=[1e300, 5, 1.6]), "between -100000 and 100000"),
        (lambda s: s.update(lens="a\nb"), "printable"),
        (lambda s: s.update(image_size=[0, 1080]), "image_size.0"),
        (lambda s: s.pop("targets"), "targets"),
    ],
)
def test_a_picture_set_with_a_mistake_is_refused(tmp_path: Path, change: Change, told: str) -> None:
    with pytest.raises(DocumentError) as error:
        read_picture_set(written(tmp_path, "set.json", SET, change))
    assert told in str(error.value)
    assert "\n" not in str(error.value)


def test_fields_of_other_tools_are_left_alone(tmp_path: Path) -> None:
    described = read_picture_set(written(tmp_path, "set.json", SET, lambda s: s.update(studio="B", comment="x")))
    assert len(described.pictures) == 2


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda j: j.update(lens='a"b\nc'), "lens: must be printable"),
        (lambda j: j.update(lens="\u202eevil"), "lens: must be printable"),
        (lambda j: j.update(targets={'a"\n': BOARD}), "printable"),
        (lambda j: j["targets"]["board"]["pose"].update(centre_m=[0.0, -5.0, 1.6]), "turns its back to the camera"),
        (lambda j: j["targets"]["board"]["pose"].update(yaw_deg=180.0), "turns its back to the camera"),
        (lambda j: j["targets"]["board"]["pose"].update(centre_m=[0.0, 0.0, 1.6]), "where the camera stands"),
        (lambda j: j["targets"]["board"].update(pose=None), "needs its surveyed place"),
        (lambda j: j.update(colour="red"), "colour"),
        (lambda j: j["levels"].append({"zoom": 0.0, "focus": 0.5}), "listed twice"),
        (lambda j: j["levels"][0].update(zoom=1.5), "levels.0.zoom"),
        (lambda j: j.update(pixel_aspect=float("nan")), "pixel_aspect"),
    ],
)
def test_a_job_with_a_mistake_is_refused(tmp_path: Path, change: Change, told: str) -> None:
    with pytest.raises(DocumentError) as error:
        read_job(written(tmp_path, "job.json", JOB, change))
    assert told in str(error.value)
    assert "\n" not in str(error.value)


def test_a_board_beside_or_behind_that_faces_the_camera_is_accepted(tmp_path: Path) -> None:
    def behind_but_facing(job: dict[str, Any]) -> None:
        job["targets"]["board"]["pose"] = {"centre_m": [0.0, -5.0, 1.6], "yaw_deg": 180.0}

    assert read_job(written(tmp_path, "job.json", JOB, behind_but_facing)).lens == "XA 20x"
