"""ST maps: there and back, the common test vector, what OpenEXR and OpenImageIO make of them, maps of other programs,
and files that are damaged or hostile."""

from __future__ import annotations

import io
import struct
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.compare import grid_pixels
from calibration.lens import Lens
from calibration.tables import LensTable
from storage.errors import BadDocument, CannotExport
from storage.exports import EXPORTS
from storage.exports.map_picture import NOTE, MapPicture, decode_map, encode_map
from storage.exports.stmap import overscan_needed, read_foreign_stmap, read_stmap, write_stmap
from tests.support.lens_tables import VECTOR_LENS, assert_carried, lens_tables, level_of, table_of

SMALL = (480, 270)
# The test vector at a quarter of the size: the same places from 0 to 1.
LENS = Lens(SMALL, 1339.375739 / 4, -0.191619, 0.0689969, (0.75, -0.5))
TABLE = table_of(level_of(LENS), image_size=SMALL)
WRITTEN = write_stmap(TABLE)
WIDER = write_stmap(TABLE, 1.2)


def files_of(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zip_of(files: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return out.getvalue()


def map_of(kind: str, data: bytes = WRITTEN) -> bytes:
    (found,) = (content for name, content in files_of(data).items() if f"_{kind}_" in name)
    return found


def between(channel: np.ndarray[Any, Any], u: float, v: float) -> float:
    """The value between four pixels."""
    x, y = int(u), int(v)
    a, b = u - x, v - y
    rows = channel[y : y + 2, x : x + 2].astype(np.float64)
    return float(np.array([1 - b, b]) @ rows @ np.array([1 - a, a]))


@settings(max_examples=12)
@given(data=st.data(), overscan=st.sampled_from([1.0, 1.1, 1.37]))
def test_there_and_back(data: st.DataObject, overscan: float) -> None:
    table = data.draw(lens_tables(sizes=((160, 90), (90, 160), (97, 61)), most=2))
    written = write_stmap(table, overscan)
    back = read_stmap(written)
    assert_carried(table, back)
    assert write_stmap(table, overscan) == written
    assert_carried(back, read_stmap(write_stmap(back)))


def test_the_test_vector() -> None:
    picture = decode_map(map_of("undistort"), "")
    at = (0.850358265 * 480 - 0.5, (1 - 0.253819307) * 270 - 0.5)
    # Four times as coarse as the vector's picture, the straight line between two pixels is 2e-6 off.
    assert between(picture.s, *at) == pytest.approx(0.832999792, abs=3e-6)
    assert between(picture.t, *at) == pytest.approx(0.266163111, abs=3e-6)


def test_names_say_which_picture_goes_in() -> None:
    assert list(files_of(WRITTEN)) == [
        "zoom0.0_focus0.5_undistort_plate-to-flat.exr",
        "zoom0.0_focus0.5_distort_flat-to-plate.exr",
    ]


def test_openexr_finds_floats_and_the_lens() -> None:
    with OpenEXR.File(io.BytesIO(map_of("undistort", WIDER))) as file:
        pixels = file.channels()["RGB"].pixels
        header = file.header()
        assert (pixels.dtype, pixels.shape) == (np.float32, (324, 576, 3))
        assert not pixels[..., 2].any()
        assert "480 x 270 px go in, 576 x 324 px come out" in header["comments"]
        for fact in ('"k1": -0.191619', '"margin_px": [48, 27]', '"job_id": "job-1"', '"overscan_needed": 1.1'):
            assert fact in header[NOTE]


def oiio_picture(values: np.ndarray[Any, Any]) -> OpenImageIO.ImageBuf:
    height, width, channels = values.shape
    picture = OpenImageIO.ImageBuf(OpenImageIO.ImageSpec(width, height, channels, OpenImageIO.FLOAT))
    picture.set_pixels(OpenImageIO.ROI(0, width, 0, height), np.ascontiguousarray(values, dtype=np.float32))
    return picture


def warp(source: np.ndarray[Any, Any], exr: bytes) -> np.ndarray[Any, Any]:
    """OpenImageIO's own use of a map: the whole picture that comes out."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.exr"
        path.write_bytes(exr)
        found = OpenImageIO.ImageBuf(str(path))
        size = (found.spec().width, found.spec().height)
        out = OpenImageIO.ImageBuf(OpenImageIO.ImageSpec(*size, source.shape[2], OpenImageIO.FLOAT))
        made = OpenImageIO.ImageBufAlgo.st_warp(
            out, oiio_picture(source), found, "triangle", 0.0, chan_s=0, chan_t=1, flip_s=False, flip_t=True
        )
        assert made, OpenImageIO.geterror() or out.geterror()
        return np.asarray(out.get_pixels(OpenImageIO.FLOAT))


def places(size: tuple[int, int]) -> np.ndarray[Any, Any]:
    """A picture of where each pixel is: (H, W, 2) = (u, v)."""
    u, v = np.meshgrid(np.arange(size[0], dtype=np.float64), np.arange(size[1], dtype=np.float64))
    return np.stack([u, v], axis=-1)


@pytest.mark.parametrize(("data", "margin"), [(WRITTEN, (0, 0)), (WIDER, (48, 27))])
def test_openimageio_warps_as_the_lens_does(data: bytes, margin: tuple[int, int]) -> None:
    """Both ways, a picture of its own coordinates goes through OpenImageIO; away from edges it is exact to 0.002 px."""
    flat = (SMALL[0] + 2 * margin[0], SMALL[1] + 2 * margin[1])
    scale, centre = LENS.f_px, np.array(LENS.principal_point_px)

    found = warp(places(SMALL), map_of("undistort", data))
    assert found.shape[:2] == flat[::-1]
    wanted = LENS.project((places(flat) - margin - centre) / scale)
    inside = np.all((wanted > 3) & (wanted < np.array(SMALL) - 4), axis=-1)
    assert inside.mean() > 0.6
    assert np.abs(found - wanted)[inside].max() < 0.002

    found = warp(places(flat), map_of("distort", data))
    assert found.shape[:2] == SMALL[::-1]
    wanted = LENS.unproject(places(SMALL)) * scale + centre + margin
    inside = np.all((wanted > 3) & (wanted < np.array(flat) - 4), axis=-1)
    assert inside.mean() > (0.99 if margin[0] else 0.6)
    assert np.abs(found - wanted)[inside].max() < 0.002


def test_a_picture_comes_back_through_both_maps() -> None:
    """Plate to flat and back, with the overscan that keeps all of it."""
    assert 1.1 < overscan_needed(LENS) < 1.2
    u, v = places(SMALL)[..., 0], places(SMALL)[..., 1]
    plate = (0.5 + 0.4 * np.sin(u / 40) * np.cos(v / 30))[..., None]
    back = warp(warp(plate, map_of("undistort", WIDER)), map_of("distort", WIDER))
    assert np.abs(back - plate)[3:-3, 3:-3].max() < 0.003


def test_where_no_ray_lands_the_map_points_beside_the_picture() -> None:
    table = table_of(level_of(Lens(SMALL, 300.0).with_hw(300.0, -0.1, 0.0)), image_size=SMALL)
    data = write_stmap(table, 2.0)
    picture = decode_map(map_of("undistort", data), "")
    assert (picture.s[0, 0], picture.t[0, 0]) == (-1, -1)
    assert np.isfinite(picture.s).all()
    assert_carried(table, read_stmap(data))


def test_one_map_alone_is_read_too() -> None:
    for kind in ("undistort", "distort"):
        assert_carried(TABLE, read_stmap(map_of(kind, WIDER)))


def test_the_advice_is_the_overscan_that_keeps_the_corners() -> None:
    advice = EXPORTS["stmap"].advice
    assert advice is not None
    assert "overscan of 1.13 keeps" in advice(TABLE)
    corners = np.array([[-0.5, -0.5], [479.5, 269.5]])
    flat = LENS.unproject(corners) * LENS.f_px + np.array(LENS.principal_point_px)
    assert np.all(np.abs(flat - np.array([239.5, 134.5])) <= np.array([240, 135]) * overscan_needed(LENS) + 1e-9)


@pytest.mark.parametrize(
    ("table", "overscan", "words"),
    [
        (TABLE, 0.9, "between 1 and 2"),
        (TABLE, float("nan"), "between 1 and 2"),
        (table_of(*(level_of(VECTOR_LENS, zoom / 100) for zoom in range(20))), 1.0, "takes 19; export one of them"),
        (table_of(level_of(Lens((16000, 9000), 9000.0)), image_size=(16000, 9000)), 1.0, "too much for one file"),
        (table_of(level_of(Lens(SMALL, 300.0, -0.9)), image_size=SMALL), 1.0, "zoom 0, focus 0.5: the lens folds"),
    ],
)
def test_what_cannot_be_drawn_is_refused(table: LensTable, overscan: float, words: str) -> None:
    with pytest.raises(CannotExport, match=words):
        write_stmap(table, overscan)


# Maps of other programs


def foreign(kind: str, write: Callable[[MapPicture], MapPicture] = lambda picture: picture) -> bytes:
    picture = write(decode_map(map_of(kind), ""))
    return encode_map(MapPicture(picture.s, picture.t))


def top_left(picture: MapPicture) -> MapPicture:
    return MapPicture(picture.s, 1 - picture.t)


def centre_to_centre(picture: MapPicture) -> MapPicture:
    width, height = picture.size
    return MapPicture(
        ((picture.s * width - 0.5) / (width - 1)).astype(np.float32),
        (1 - ((1 - picture.t) * height - 0.5) / (height - 1)).astype(np.float32),
    )


@pytest.mark.parametrize("kind", ["undistort", "distort"])
@pytest.mark.parametrize("write", [lambda picture: picture, top_left, centre_to_centre])
def test_a_foreign_map_gives_the_lens_with_a_field_of_view(
    kind: str, write: Callable[[MapPicture], MapPicture]
) -> None:
    data = foreign(kind, write)
    with pytest.raises(BadDocument, match=r"k1_hw -0\.0984.*no map tells the field of view; give it: --fov-x"):
        read_stmap(data)
    table = read_foreign_stmap(data, LENS.fov_x_deg)
    (level,) = table.levels
    assert (level.zoom, level.focus, level.nodal_offset_mm) == (0.0, 0.0, None)
    pixels = grid_pixels(SMALL)
    assert np.abs(level.lens(SMALL).project(LENS.unproject(pixels)) - pixels).max() < 0.01


def test_foreign_maps_that_tell_no_lens_are_refused() -> None:
    width, height = SMALL
    u, v = places(SMALL)[..., 0], places(SMALL)[..., 1]
    s, t = ((u + 0.5) / width).astype(np.float32), (1 - (v + 0.5) / height).astype(np.float32)
    for picture, words in (
        (MapPicture(s, t), "too little to show which way"),
        (MapPicture(np.full_like(s, np.nan), t), "too few pixels"),
        (MapPicture((s * 1.02).astype(np.float32), t), "not a lens of k1 and k2"),
        (MapPicture(np.zeros_like(s), np.zeros_like(s)), "not a lens of k1 and k2"),
    ):
        with pytest.raises(BadDocument, match=words):
            read_stmap(encode_map(picture))
    with pytest.raises(BadDocument, match="tells its own field of view"):
        read_foreign_stmap(map_of("distort"), 70.0)
    with pytest.raises(BadDocument, match="between 0 and 180"):
        read_foreign_stmap(foreign("distort"), 180.0)
    with pytest.raises(BadDocument, match="holds 2 maps"):
        read_foreign_stmap(WRITTEN, 70.0)


# Damaged and hostile files


def with_size(width: int, height: int) -> bytes:
    """A map whose header tells another size."""
    exr = map_of("distort")
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        at = exr.index(name) + len(name) + 4
        exr = exr[:at] + struct.pack("<4i", 0, 0, width - 1, height - 1) + exr[at + 16 :]
    return exr


def changed(change: Callable[[np.ndarray[Any, Any]], object], note: str | None = None) -> bytes:
    picture = decode_map(map_of("distort"), "")
    s = picture.s.copy()
    change(s)
    return encode_map(MapPicture(s, picture.t, {NOTE: note or picture.texts[NOTE]}))


def set_pixel(value: float) -> Callable[[np.ndarray[Any, Any]], object]:
    return lambda s: s.__setitem__((100, 200), value)


NOTE_TEXT = decode_map(map_of("distort"), "").texts[NOTE]
HALF = io.BytesIO()
OpenEXR.File({}, {"RGB": np.zeros((8, 8, 3), np.float16)}).write(HALF)
BOMB = io.BytesIO()
with zipfile.ZipFile(BOMB, "w", zipfile.ZIP_DEFLATED) as _archive:
    _archive.writestr("a.exr", bytes(50_000_000))
LIE = BOMB.getvalue().replace(struct.pack("<I", 50_000_000), struct.pack("<I", 2**31))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is no OpenEXR picture"),
        (b"PK\3\4", "damaged ZIP"),
        (WRITTEN[: len(WRITTEN) // 2], "damaged ZIP"),
        (WRITTEN.replace(map_of("distort")[5000:5100], bytes(100)), "damaged ZIP"),
        (zip_of({}), "holds no map"),
        (zip_of({"a.txt": b"x"}), "is no EXR file"),
        (zip_of({"a.exr": map_of("distort"), "b.exr": map_of("distort")}), "contradicts another map"),
        (
            zip_of({"a.exr": map_of("distort"), "b.exr": changed(lambda s: None, NOTE_TEXT.replace("XA", "XB"))}),
            "of another table",
        ),
        (BOMB.getvalue(), "is no OpenEXR picture"),
        (LIE, "unpacks to 1 files of 2147483648 bytes"),
        (map_of("distort")[:500], "damaged or cut header"),
        (map_of("distort")[:-1], "is cut off"),
        (with_size(2**31 - 1, 2**31 - 1), "at most 50000000 px"),
        (with_size(90_000, 90_000), "at most 50000000 px"),
        (with_size(-5, 7), "at most 50000000 px"),
        (with_size(480, 40_000), "is cut off"),
        (HALF.getvalue(), "no 32-bit float R and G"),
        (changed(set_pixel(0.5)), "px off the lens in its header"),
        (changed(lambda s: s.__iadd__(np.float32(0.02 / 480))), "0.0[12].* px off the lens"),
        (changed(set_pixel(np.nan)), "inf px off"),
        (changed(lambda s: None, NOTE_TEXT.replace('"k1": -0.19', '"k1": -0.20')), "px off the lens"),
        (changed(lambda s: None, NOTE_TEXT.replace('"k1": -0.19', '"k1": -3.0')), "folds inside"),
        (changed(lambda s: None, NOTE_TEXT.replace('"k1": -0.191619', '"k1": NaN')), "holds NaN"),
        (changed(lambda s: None, NOTE_TEXT.replace('"lens_table": 1', '"lens_table": 2')), "table.lens_table"),
        (changed(lambda s: None, NOTE_TEXT.replace('"margin_px": [0', '"margin_px": [-1')), "margin_px"),
        (changed(lambda s: None, NOTE_TEXT.replace("[480, 270]", "[960, 540]")), "its header tells 960 x 540"),
        (changed(lambda s: None, "no json"), "is not JSON"),
    ],
)
def test_bad_files_are_one_line(data: bytes, words: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(BadDocument, match=words) as raised:
        read_stmap(data)
    assert "\n" not in str(raised.value)
    assert capfd.readouterr().out == ""


def test_the_same_file_name_twice_is_refused() -> None:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("a.exr", map_of("distort"))
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("a.exr", map_of("distort"))
    with pytest.raises(BadDocument, match="a file twice"):
        read_stmap(out.getvalue())


def test_a_level_that_is_missing_is_noticed() -> None:
    table = table_of(level_of(LENS), level_of(replace(LENS, f_px=900.0), 1.0), image_size=SMALL)
    files = files_of(write_stmap(table))
    kept = {name: content for name, content in files.items() if not name.startswith("zoom1")}
    with pytest.raises(BadDocument, match="has 1 levels of the 2"):
        read_stmap(zip_of(kept))


@settings(max_examples=60)
@given(data=st.data())
def test_a_damaged_zip_is_read_rightly_or_refused(data: st.DataObject) -> None:
    start = data.draw(st.integers(0, 3000) | st.integers(len(WRITTEN) - 500, len(WRITTEN)))
    length = data.draw(st.sampled_from([0, 1, 4, 1000]))
    damaged = WRITTEN[:start] + data.draw(st.binary(max_size=4)) + WRITTEN[start + length :]
    try:
        table = read_stmap(damaged)
    except BadDocument as error:
        assert "\n" not in str(error)  # noqa: PT017 either outcome is right
    else:
        assert_carried(TABLE, table)
