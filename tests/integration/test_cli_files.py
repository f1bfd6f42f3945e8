"""The commands that work on files: calibrate, detect, export, import, and what they say of bad ones."""

from __future__ import annotations

import hashlib
import json
import struct
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from app.cli.commands import cli
from app.jobs.provenance import inputs_sha256, sha256_of_all
from benchmarks.pictures import draw_board, random_view
from calibration.compare import overlay
from calibration.lens import Lens
from calibration.tables import LevelResult
from storage.exports import EXPORTS
from storage.exports.map_picture import MapPicture, decode_map, encode_map
from tests.support.lens_tables import NO_EVIDENCE, assert_carried, table_of

import cv2  # isort: skip  (calibration.image sets OpenCV's bound on picture sizes before its first import)

RUNNER = CliRunner()
SQUARES = (7, 6)
SMALL_LENS = Lens((160, 90), 120.0, -0.15, 0.03, (1.5, -0.5))


def invoke(*words: str | Path) -> Result:
    return RUNNER.invoke(cli, [str(word) for word in words])


def reason(result: Result, code: int = 1) -> str:
    """The one error line of a command that failed with this code and printed nothing else."""
    assert result.exit_code == code, result.output
    lines = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, result.stderr
    assert result.stdout == ""
    return lines[0]


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray[Any, Any]]:
    """A picture of a board, and where its inner corners are."""
    rng = np.random.default_rng(7)
    drawn = draw_board(SQUARES, random_view(SQUARES, rng, size=(640, 480)), 0.8, 1.0, rng)
    path = tmp_path_factory.mktemp("pictures") / "board.png"
    path.write_bytes(cv2.imencode(".png", drawn.picture)[1].tobytes())
    return path, drawn.corners


def test_detect_prints_one_json_document(board: tuple[Path, np.ndarray[Any, Any]]) -> None:
    path, corners = board
    result = invoke("detect", path, "--target", "chessboard:7x6", "--json")
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)
    assert found["found"] is True
    assert found["kind"] == "chessboard"
    assert found["point_ids"] == list(range(30))
    assert np.abs(np.array(found["points"]) - corners).max() < 0.1
    assert np.array(found["covariance"]).shape == (30, 2, 2)
    assert len(found["centre"]) == 2
    assert 0.2 < found["blur_px"] < 2
    assert 0 < found["quality"]["score"] <= 1
    assert found["seconds"] > 0


def test_detect_shows_a_table_and_draws_the_points(board: tuple[Path, np.ndarray[Any, Any]], tmp_path: Path) -> None:
    out = tmp_path / "drawn.png"
    result = invoke("detect", board[0], "--target", "chessboard:7x6", "--picture-out", out)
    assert result.exit_code == 0, result.stderr
    assert "30 of 30 points" in result.stdout
    drawn, plain = cv2.imread(str(out)), cv2.imread(str(board[0]))
    assert drawn.shape == plain.shape
    assert (drawn != plain).any()


def test_a_target_that_is_not_there_is_said_in_json_and_by_the_exit_code(tmp_path: Path) -> None:
    path = tmp_path / "grey.png"
    path.write_bytes(cv2.imencode(".png", np.full((120, 160, 3), 90, np.uint8))[1].tobytes())
    result = invoke("detect", path, "--target", "square", "--json", "--picture-out", tmp_path / "drawn.png")
    assert result.exit_code == 1
    told = json.loads(result.stdout)
    assert told["found"] is False
    assert told["reason"]
    assert told["reason"] in reason(invoke("detect", path, "--target", "square"))
    assert not (tmp_path / "drawn.png").exists()


def _huge_png() -> bytes:
    """A PNG whose header promises 60000 x 60000 pixels."""
    header = b"IHDR" + struct.pack(">IIBBBBB", 60000, 60000, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    return b"\x89PNG\r\n\x1a\n" + chunk + struct.pack(">I", 0) + b"IEND" + struct.pack(">I", zlib.crc32(b"IEND"))


BAD_PICTURES = {
    "empty.png": b"",
    "garbage.png": b"this is no picture" * 10,
    "cut.png": b"\x89PNG\r\n\x1a\n" + bytes(20),
    "huge.png": _huge_png(),
}


@pytest.mark.parametrize("name", BAD_PICTURES)
def test_a_bad_picture_is_one_line(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(BAD_PICTURES[name])
    assert name in reason(invoke("detect", path, "--target", "light"))
    told = json.loads(invoke("detect", path, "--target", "light", "--json").stdout)
    assert told["found"] is False


def test_a_missing_picture_and_a_folder_are_one_line(tmp_path: Path) -> None:
    assert "none.png" in reason(invoke("detect", tmp_path / "none.png", "--target", "light"))
    assert "not a file" in reason(invoke("detect", tmp_path, "--target", "light"))


def picture_set(folder: Path, **changes: Any) -> dict[str, Any]:
    """A set of four bad pictures in ``folder``, as a document."""
    for name, data in BAD_PICTURES.items():
        (folder / name).write_bytes(data)
    document: dict[str, Any] = {
        "picture_set": 1,
        "lens": "test lens",
        "camera": "Cam0",
        "image_size": [640, 480],
        "targets": {"board": {"kind": "chessboard", "squares": list(SQUARES), "square_m": 0.05}},
        "pictures": [{"file": name, "zoom": 0.0, "focus": 0.0, "target": "board"} for name in BAD_PICTURES],
    }
    document |= changes
    (folder / "set.json").write_text(json.dumps(document), "utf-8")
    return document


def test_a_set_without_a_usable_picture_fails_with_the_reasons(tmp_path: Path) -> None:
    picture_set(tmp_path)
    out = tmp_path / "table.json"
    told = reason(invoke("calibrate", tmp_path, "--out", out))
    assert "no level could be measured" in told
    assert not out.exists()
    for why in (
        "empty.png: the picture is empty",
        "cut.png: picture = '28 bytes': not a PNG",
        "garbage.png: not a PNG",
    ):
        assert told.count(why) == 1, told
    assert "empty.png: empty.png" not in told


def test_what_fails_is_one_json_document_too(tmp_path: Path) -> None:
    picture_set(tmp_path)
    for words, levels in (
        (["calibrate", tmp_path], 1),
        (["calibrate", tmp_path / "none"], 0),
        (["import", tmp_path / "none.csv", "--format", "csv"], 0),
        (["import", tmp_path / "none.csv", "--format", "xyz"], 0),
        (["export", tmp_path / "none.json", "--format", "csv", "--out", tmp_path / "out.csv"], 0),
        (["detect", tmp_path / "none.png", "--target", "triangle"], 0),
        (["detect", tmp_path / "garbage.png", "--target", "light"], 0),
        (["doctor", "--studio", tmp_path / "none.toml"], 0),
        (["doctor", "--print-profile"], 0),
        (["run", tmp_path / "none.json"], 0),
        (["serve", "--profile", tmp_path / "none.toml", "--database", tmp_path / "x.db"], 0),
        (["demo", "--lens", "none"], 0),
        (["simulate", "--lens", "none"], 0),
    ):
        plain, document = invoke(*words), invoke(*words, "--json")
        told = json.loads(document.stdout)
        if words[0] != "doctor" or "--print-profile" not in words:
            assert plain.stdout == ""
            assert plain.exit_code == document.exit_code > 0
            assert f"error: {told['error']}" in plain.stderr
        assert len(told.get("levels", [])) == levels, words
        assert all(level.keys() == {"zoom", "focus", "reason"} for level in told.get("levels", []))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"image_size": [0, 480]}, "image_size"),
        ({"image_size": [640, float("nan")]}, "image_size"),
        ({"pictures": []}, "pictures"),
        ({"targets": {"board": {"kind": "chessboard", "squares": [7, 6], "square_m": 0}}}, "square_m"),
        ({"targets": {"board": {"kind": "chessboard", "squares": [7, 6], "square_m": float("nan")}}}, "square_m"),
        ({"targets": {"board": {"kind": "ellipse"}}}, "kind"),
        ({"pictures": [{"file": "a.png", "target": "door"}]}, "door"),
        ({"picture_set": 2}, "picture_set"),
    ],
)
def test_a_bad_picture_set_names_the_field(changes: dict[str, Any], told: str, tmp_path: Path) -> None:
    picture_set(tmp_path, **changes)
    assert told in reason(invoke("calibrate", tmp_path))


def test_a_picture_set_that_is_not_there_or_no_json(tmp_path: Path) -> None:
    assert "no such folder" in reason(invoke("calibrate", tmp_path / "none"))
    assert "there is no set.json" in reason(invoke("calibrate", tmp_path))
    (tmp_path / "set.json").write_text('{"picture_set": 1,\n "lens" "x"}', "utf-8")
    assert "line 2" in reason(invoke("calibrate", tmp_path))


def test_the_out_file_is_checked_before_the_work(tmp_path: Path) -> None:
    picture_set(tmp_path)
    assert "there is no folder" in reason(invoke("calibrate", tmp_path, "--out", tmp_path / "no" / "t.json"))
    assert "is a folder" in reason(invoke("calibrate", tmp_path, "--report", tmp_path))
    locked = tmp_path / "locked"
    locked.write_text("a file, not a folder")
    assert "no folder" in reason(invoke("calibrate", tmp_path, "--out", locked / "t.json"))


@pytest.mark.parametrize("method", ["joint", "alternating"])
def test_both_methods_calibrate_rendered_pictures(method: str, shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "renders" / "chess_Z0F0"
    out = tmp_path / "table.json"
    words = ("calibrate", folder, "--method", method, "--out", out, "--json", "--report", tmp_path / "report.html")
    result = invoke(*words)
    assert result.exit_code == 0, result.stderr
    document = json.loads(result.stdout)
    assert document["method"] == method
    table = EXPORTS["json"].read(out.read_bytes())
    assert document == json.loads(out.read_bytes())
    (level,) = table.levels
    assert level.frames.real == 4
    assert table.provenance is not None
    assert (table.provenance.source, table.provenance.job_id) == ("calibrated", None)
    files = [folder / name for name in dict.fromkeys(one["file"] for one in _set(folder)["pictures"])]
    expected = inputs_sha256(table.levels) if method == "joint" else _sha256_of(files)
    assert table.provenance.inputs_sha256 == expected is not None
    true = json.loads((folder / "truth.json").read_text("utf-8"))
    truth = _true_lens(true, table.image_size, table.pixel_aspect)
    assert overlay(truth, level.lens(table.image_size, table.pixel_aspect)).max_px < 0.3
    assert (tmp_path / "report.html").read_bytes().startswith(b"<!")


def _set(folder: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((folder / "set.json").read_text("utf-8"))
    return document


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _sha256_of(files: list[Path]) -> str:
    return sha256_of_all(_hash(file.read_bytes()) for file in files)


def _true_lens(true: dict[str, Any], image_size: tuple[int, int], pixel_aspect: float) -> Lens:
    level = true["levels"][0] if "levels" in true else true
    return Lens.from_fov(
        image_size,
        level["fov_x_deg"],
        k1=level["k1"],
        k2=level["k2"],
        center_shift_px=tuple(level["center_shift_px"]),
        pixel_aspect=pixel_aspect,
    )


def test_the_alternating_method_says_what_it_lacks(shared_data: Path) -> None:
    told = reason(invoke("calibrate", shared_data / "photos_chessboard", "--method", "alternating"))
    assert "needs posed pictures of the roles center_shift, fov, k1, k2" in told


def test_photographs_are_shown_with_sigmas_and_what_was_left_out(shared_data: Path) -> None:
    result = invoke("calibrate", shared_data / "photos_chessboard")
    assert result.exit_code == 0, result.stderr
    assert "FoV x deg" in result.stdout
    assert "left out board_15.jpg" in result.stderr


def test_a_table_goes_through_csv_and_back(repository: Path, tmp_path: Path) -> None:
    golden = repository / "tests" / "golden" / "lens_table.json"
    table = EXPORTS["json"].read(golden.read_bytes())
    out, back = tmp_path / "t.csv", tmp_path / "back.json"
    result = invoke("export", golden, "--format", "csv", "--out", out, "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["out"] == str(out)
    assert invoke("import", out, "--format", "csv", "--out", back).exit_code == 0
    read = EXPORTS["json"].read(back.read_bytes())
    assert replace(read, provenance=table.provenance) == table
    assert read.provenance is not None
    assert (read.provenance.source, read.provenance.inputs_sha256) == ("imported", _hash(out.read_bytes()))
    assert read.provenance.parent_sha256 == _hash(EXPORTS["json"].write(table))
    printed = invoke("import", out, "--format", "csv", "--json")
    assert json.loads(printed.stdout) == json.loads(back.read_bytes())
    shown = invoke("import", out, "--format", "csv")
    assert table.lens in shown.stdout


def test_what_a_format_does_to_a_table_is_said(repository: Path, tmp_path: Path) -> None:
    golden = repository / "tests" / "golden" / "lens_table.json"
    out = tmp_path / "t.nk"
    said = invoke("export", golden, "--format", "nuke-3de", "--out", out).stderr
    assert "max 1.6 px at zoom 0, focus 0.5" in said
    assert "not in this format: k1 and k2 themselves" in said
    told = json.loads(invoke("export", golden, "--format", "opentrackio-du", "--out", out, "--json").stdout)
    assert "entrancePupilOffset" in told["cannot_carry"][1]
    assert "max 0.00047 px at zoom 0, focus 0.5" in told["advice"][0]


@pytest.mark.parametrize("name", [name for name, export in EXPORTS.items() if export.cannot_carry])
def test_a_table_goes_through_every_format(repository: Path, tmp_path: Path, name: str) -> None:
    """A small picture, so that the formats that draw one are fast."""
    level = LevelResult.from_lens(0.25, 0.5, SMALL_LENS, reasons=NO_EVIDENCE)
    table = table_of(level, LevelResult.failed(0.5, 0.5, "no board"), image_size=SMALL_LENS.image_size)
    source, out, back = tmp_path / "t.json", tmp_path / f"t{EXPORTS[name].suffix}.out", tmp_path / "back.json"
    source.write_bytes(EXPORTS["json"].write(table))
    result = invoke("export", source, "--format", name, "--out", out)
    assert result.exit_code == 0, result.stderr
    assert "1 of 2 levels" in result.stderr
    assert "not in this format: sigmas" in result.stderr
    assert invoke("import", out, "--format", name, "--out", back).exit_code == 0
    assert_carried(table, EXPORTS["json"].read(back.read_bytes()))
    told = json.loads(invoke("export", source, "--format", name, "--out", out, "--json").stdout)
    assert told["cannot_carry"] == list(EXPORTS[name].cannot_carry)
    out.write_bytes(out.read_bytes()[:-40])
    assert str(out) in reason(invoke("import", out, "--format", name))


def test_one_place_of_a_table_is_exported(tmp_path: Path) -> None:
    source, out = tmp_path / "t.json", tmp_path / "out.csv"
    places = [(0.0, 0.0), (0.0, 0.5), (1.0, 0.5)]
    levels = (LevelResult.from_lens(zoom, focus, SMALL_LENS, reasons=NO_EVIDENCE) for zoom, focus in places)
    source.write_bytes(EXPORTS["json"].write(table_of(*levels, image_size=SMALL_LENS.image_size)))

    def exported(*words: str) -> list[tuple[float, float]]:
        result = invoke("export", source, "--format", "csv", "--out", out, *words)
        assert result.exit_code == 0, result.stderr
        return [(level.zoom, level.focus) for level in EXPORTS["csv"].read(out.read_bytes()).levels]

    assert exported() == places
    assert exported("--zoom", "0") == places[:2]
    assert exported("--focus", "0.5") == places[1:]
    assert exported("--zoom", "0", "--focus", "0.5") == [(0.0, 0.5)]
    words = ("export", source, "--format", "csv", "--out", out)
    assert "no level has this zoom; the table has zoom 0, 1" in reason(invoke(*words, "--zoom", "0.3"))
    assert exported("--zoom", "0.4", "--focus", "0.2") == [(0.4, 0.2)]
    assert "outside the table's levels" in reason(invoke(*words, "--zoom", "0.4", "--focus", "0.9"))


def test_st_maps_have_options_of_their_own(tmp_path: Path) -> None:
    source, out, single = tmp_path / "t.json", tmp_path / "t.zip", tmp_path / "one.exr"
    level = LevelResult.from_lens(0.25, 0.5, SMALL_LENS, reasons=NO_EVIDENCE)
    source.write_bytes(EXPORTS["json"].write(table_of(level, image_size=SMALL_LENS.image_size)))
    result = invoke("export", source, "--format", "stmap", "--overscan", "1.25", "--out", out, "--json")
    assert result.exit_code == 0, result.stderr
    assert "keeps every pixel" in json.loads(result.stdout)["advice"][0]
    with zipfile.ZipFile(out) as archive:
        undistort, _ = (decode_map(archive.read(name), "") for name in archive.namelist())
    assert undistort.size == (200, 114)  # 160 x 90 and 20, 12 px on each side
    map_without_lens = encode_map(MapPicture(undistort.s[12:-12, 20:-20], undistort.t[12:-12, 20:-20]))
    single.write_bytes(map_without_lens)
    assert "give it: --fov-x" in reason(invoke("import", single, "--format", "stmap"))
    result = invoke("import", single, "--format", "stmap", "--fov-x", str(SMALL_LENS.fov_x_deg), "--json")
    (found,) = json.loads(result.stdout)["levels"]
    assert found["k1"] == pytest.approx(SMALL_LENS.k1, rel=1e-3)
    assert "--overscan is for ST maps" in reason(
        invoke("export", source, "--format", "csv", "--overscan", "1.2", "--out", out), 2
    )
    assert "--fov-x is for ST maps" in reason(invoke("import", source, "--format", "json", "--fov-x", "50"), 2)


def test_bad_tables_are_one_line_and_leave_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out.csv"
    bad = tmp_path / "bad.json"
    for data, told in ((b"", "not JSON"), (b'{"lens_table": 1}', "lens: field required"), (b"\xff\xfe\x00", "UTF-8")):
        bad.write_bytes(data)
        line = reason(invoke("export", bad, "--format", "csv", "--out", out))
        assert str(bad) in line
        assert told in line
    assert "no such file" in reason(invoke("export", tmp_path / "none.json", "--format", "csv", "--out", out))
    assert "is a folder" in reason(invoke("import", tmp_path, "--format", "csv"))
    assert [path.name for path in tmp_path.iterdir()] == ["bad.json"]


def test_an_out_file_stays_whole_when_writing_fails(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "t.csv"
    out.write_text("the old one")

    def full(self: Path, data: bytes) -> int:
        raise OSError(28, "No space left on device", str(self))

    monkeypatch.setattr(Path, "write_bytes", full)
    golden = repository / "tests" / "golden" / "lens_table.json"
    assert "No space left" in reason(invoke("export", golden, "--format", "csv", "--out", out))
    assert out.read_text() == "the old one"
    assert [path.name for path in tmp_path.iterdir()] == ["t.csv"]


def test_a_demo_into_a_file_is_one_line(tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.write_text("")
    assert "is a file already" in reason(invoke("demo", "--out", taken))
