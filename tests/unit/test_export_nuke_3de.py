"""Nuke scripts with 3DEqualizer lens nodes: the test vector in their units, round trips, plain nodes and bad files."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.compare import grid_pixels, overlay
from calibration.lens import Lens
from calibration.tables import LensTable, LevelResult, LevelStatus
from storage.errors import BadDocument, CannotExport
from storage.exports import EXPORTS
from storage.exports.nuke_3de import read_nuke, write_nuke
from tests.support.real_lenses import SIZE, VECTOR, assert_same_lenses, level_of, real_tables, table_of, vector_table

NUKE = EXPORTS["nuke-3de"]

# A node as other programs write it, its numbers those of the worked refit of the test vector's lens.
PLAIN = """LD_3DE4_Radial_Standard_Degree_4 {
  tde4_focal_length_cm 0.9199
  tde4_custom_focus_distance_cm 5.0
  tde4_filmback_width_cm 1.31868
  tde4_filmback_height_cm 0.74176
  tde4_lens_center_offset_x_cm 0.0
  tde4_lens_center_offset_y_cm 0.0
  tde4_pixel_aspect 1.0
  Distortion_Degree_2 0.14306933
  U_Degree_2 0
  V_Degree_2 0
  Quartic_Distortion_Degree_4 -0.01280777
  U_Degree_4 0
  V_Degree_4 0
  Phi_Cylindric_Direction 0
  B_Cylindric_Bending 0
  direction undistort
  field_of_view_xa_unit 0.0
  field_of_view_xb_unit 1.0
  field_of_view_ya_unit 0.0
  field_of_view_yb_unit 1.0
  name lens1
}
"""


def text_of(table: LensTable) -> str:
    return write_nuke(table).decode()


def two_levels() -> LensTable:
    return table_of(level_of(VECTOR), level_of(VECTOR.with_hw(VECTOR.f_px * 2, 0.02, 0.01), 0.5))


def without_comments(text: str) -> str:
    return "".join(line for line in text.splitlines(keepends=True) if not line.startswith("#"))


def knobs_of(text: str) -> dict[str, float]:
    """The numeric knobs of a script's first node."""
    body = text[text.index("LD_3DE4") :].split("\n}")[0]
    return {name: float(value) for name, value in re.findall(r"^ +(\w+) (-?\d[\d.e+-]*)$", body, re.MULTILINE)}


# Golden values


def test_the_test_vector_in_half_diagonals() -> None:
    found = knobs_of(text_of(vector_table()))
    assert found["tde4_focal_length_cm"] == pytest.approx(0.9199)
    assert found["tde4_filmback_width_cm"] == 1.31868
    assert found["tde4_filmback_height_cm"] == pytest.approx(0.74176, abs=1e-5)
    assert found["tde4_lens_center_offset_x_cm"] == pytest.approx(0.0020604375)
    assert found["tde4_lens_center_offset_y_cm"] == pytest.approx(0.0013736296, abs=5e-9)
    # The worked refit, of the centred lens, has 0.14306933 and -0.01280777.
    assert found["Distortion_Degree_2"] == pytest.approx(0.14306933, rel=0.01)
    assert found["Quartic_Distortion_Degree_4"] == pytest.approx(-0.01280777, rel=0.08)
    assert [found[name] for name in ("field_of_view_xa_unit", "field_of_view_xb_unit")] == [0, 1]
    assert all(found[name] == 0 for name in found if name.startswith(("U_", "V_", "B_", "Phi_")))


def test_the_nodes_own_equation_is_off_by_what_its_label_says() -> None:
    """The node's numbers put through its equation by hand, against the lens itself, over the picture."""
    text = text_of(vector_table())
    found = knobs_of(text)
    width_cm, height_cm = found["tde4_filmback_width_cm"], found["tde4_filmback_height_cm"]
    half = math.hypot(width_cm, height_cm) / 2
    pixels = grid_pixels(SIZE)
    x = ((pixels[..., 0] + 0.5) / SIZE[0] - 0.5) * width_cm - found["tde4_lens_center_offset_x_cm"]
    y = (0.5 - (pixels[..., 1] + 0.5) / SIZE[1]) * height_cm - found["tde4_lens_center_offset_y_cm"]
    r2 = (x * x + y * y) / half**2
    gain = 1 + found["Distortion_Degree_2"] * r2 + found["Quartic_Distortion_Degree_4"] * r2 * r2
    rays = np.stack([x * gain, -y * gain], axis=-1) / found["tde4_focal_length_cm"]
    error = np.linalg.norm(VECTOR.project(rays) - pixels, axis=-1)
    assert f'label "zoom 0, focus 0.5: off by rms {np.sqrt(np.mean(error**2)):.2g}, max {error.max():.2g} px"' in text
    assert error.max() == pytest.approx(1.61, abs=0.01)


def test_the_refit_is_told_to_the_operator() -> None:
    assert NUKE.advice is not None
    assert "rms 0.52, max 1.6 px at zoom 0, focus 0.5, and no more elsewhere" in NUKE.advice(two_levels())


# There and back


@settings(max_examples=40)
@given(table=real_tables())
def test_there_and_back(table: LensTable) -> None:
    assert_same_lenses(table, read_nuke(write_nuke(table)), 1e-8)


def test_names_cannot_break_out_of_their_comment() -> None:
    table = LensTable('a "}\\', "{ [exec rm]", 1, vector_table().created, SIZE, "joint", (level_of(VECTOR),), (10, 5.6))
    back = read_nuke(write_nuke(table))
    assert (back.lens, back.camera) == (table.lens, table.camera)


def test_a_script_that_lost_its_comments_is_read_by_refit() -> None:
    table = read_nuke(without_comments(text_of(vector_table())).encode())
    (level,) = table.levels
    assert level.status is LevelStatus.DEGRADED
    assert "off by up to 1.4 px" in str(level.reason)
    assert table.provenance is not None
    assert "1920 x 1080 was taken" in str(table.provenance.note)
    assert overlay(VECTOR, level.lens(table.image_size)).max_px < 1.7


# Plain nodes


def test_a_plain_node_is_read() -> None:
    table = read_nuke(PLAIN.encode())
    (level,) = table.levels
    assert (table.image_size, table.pixel_aspect) == (SIZE, 1.0)
    assert table.sensor_mm == pytest.approx((13.1868, 7.4176))
    assert (level.zoom, level.focus, level.nodal_offset_mm) == (0.0, 0.0, None)
    centred = Lens(SIZE, VECTOR.f_px, VECTOR.k1, VECTOR.k2)
    assert overlay(centred, level.lens(SIZE)).max_px < 2


def test_the_scripts_own_format_tells_the_pictures_size() -> None:
    root = 'Root {\n inputs 0\n name "/a {b}.nk"\n format "3840 2160 0 0 3840 2160 1 UHD"\n lut {{"a" b}\n {c}}\n}\n'
    table = read_nuke(f"#! Nuke -nx\nversion 15.0 v4\n{root}{PLAIN}".encode())
    assert table.image_size == (3840, 2160)
    assert table.provenance is not None
    assert "was taken" not in str(table.provenance.note)


def test_knobs_at_their_defaults_may_be_missing() -> None:
    default = re.compile(r"  (U_|V_|Phi|B_|field|tde4_(lens|pixel|custom))")
    lines = [line for line in PLAIN.splitlines() if not default.match(line)]
    assert read_nuke("\n".join(lines).encode()).levels[0].k1 == read_nuke(PLAIN.encode()).levels[0].k1


# What cannot be written


def test_tables_that_cannot_be_carried() -> None:
    no_sensor = LensTable("a", "b", 1, vector_table().created, SIZE, "joint", (level_of(VECTOR),))
    folded = table_of(level_of(Lens(SIZE, 1000.0, k1=-0.5)))
    failed = table_of(LevelResult.failed(0, 0, "no board"))
    for table, words in ((no_sensor, "sensor_mm"), (folded, "folds"), (failed, "no level of this table")):
        with pytest.raises(CannotExport, match=words):
            write_nuke(table)


# Bad files


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("LD_3DE4_Radial_Standard_Degree_4", "LensDistortion", "has no LD_3DE4_Radial_Standard_Degree_4 node"),
        ("  name lens1\n}\n", "", "line 1: opens a node that has no end"),
        ("Distortion_Degree_2 0.14306933", "Distortion_Degree_2 {{curve x1 0.1 x2 0.11}}", "is animated"),
        ("Distortion_Degree_2 0.14306933", "Distortion_Degree_2 {{curve x1 0.1 x2 0.11", "has no end"),
        ("Distortion_Degree_2 0.14306933", "Distortion_Degree_2 nan", "'nan', no number"),
        ("Distortion_Degree_2 0.14306933", "Distortion_Degree_2 1e999", "'1e999', no number"),
        ("Distortion_Degree_2 0.14306933", "Distortion_Degree_2 much", "node lens1: Distortion_Degree_2 is 'much'"),
        ("Distortion_Degree_2 0.14306933", "Distortion_Degree_2", "no number"),
        ("Distortion_Degree_2 0.14306933", "Distortion_Degree_2 -3", "has a pole or folds"),
        ("Distortion_Degree_2 0.14306933", "Distortion_Degree_2 1e300", "fold"),
        ("  U_Degree_2 0\n", "  U_Degree_2 0.01\n", "U_Degree_2 is not 0"),
        ("field_of_view_xb_unit 1.0", "field_of_view_xb_unit 0.5", "field_of_view_xb_unit is not 1"),
        ("  V_Degree_2 0\n", "  V_Degree_2 0\n  V_Degree_2 0\n", "gives V_Degree_2 a second time"),
        ("  tde4_focal_length_cm 0.9199\n", "", "has no tde4_focal_length_cm"),
        ("tde4_focal_length_cm 0.9199", "tde4_focal_length_cm -1", "must be a length in centimetres"),
        ("  tde4_filmback_width_cm 1.31868\n", "", "has no tde4_filmback_width_cm"),
        ("tde4_filmback_height_cm 0.74176", "tde4_filmback_height_cm 0", "must be a length in centimetres"),
        ("tde4_pixel_aspect 1.0", "tde4_pixel_aspect 1e6", "image size"),
        ("  name lens1", "  ;;;", "line 22: is no knob of a node"),
        ("}\n", "}\n" + PLAIN, "is the second node, and no comment tells zoom and focus"),
        ("  name lens1", "  name " + "{" * 100, "nested too deeply"),
    ],
)
def test_each_mistake_is_named(old: str, new: str, words: str) -> None:
    assert old in PLAIN
    with pytest.raises(BadDocument, match=words) as raised:
        read_nuke(PLAIN.replace(old, new, 1).encode())
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("pattern", "new", "words"),
    [
        (r"Distortion_Degree_2 0\.14", "Distortion_Degree_2 0.15", "is not the refit of k1, k2 in the comment"),
        (r'"k1": -0\.19', '"k1": -0.18', "is not the refit of k1, k2 in the comment"),
        (r'"k1": -0\.19', '"k1": -0.9', "folds inside"),
        (r'"k1": [-.\d]+, ', "", "k1"),
        (r'"zoom": 0\.5', '"zoom": 0.0', "twice"),
        (r"# lensmatch level .*\n", "", "has no comment of its level before it"),
        (r'"levels": 2', '"levels": 3', "2 levels of the 3"),
        (r'"lens_table": 1', '"lens_table": 2', "lens_table"),
        (r"(# lensmatch level .*\n)", r"\1\1", "note of a level without its node"),
        (r"(# lensmatch table .*\n)", r"\1\1", "is the second note of a table"),
        (r"\Z", '# lensmatch level {"zoom": 1}\n', "note of a level without its node"),
        (r"(?s) name lens2.*", "", "has no end: the file is cut off"),
        (r"(?s)# lensmatch level [^#]*\Z", "", "1 levels of the 2"),
        (r"# lensmatch table .", "# lensmatch table ", "is not JSON"),
    ],
)
def test_a_comment_that_contradicts_its_node_is_refused(pattern: str, new: str, words: str) -> None:
    text, count = re.subn(pattern, new, text_of(two_levels()), count=1)
    assert count == 1
    with pytest.raises(BadDocument, match=words) as raised:
        read_nuke(text.encode())
    assert "\n" not in str(raised.value)


@settings(max_examples=100)
@given(draw=st.data(), plain=st.booleans())
def test_a_damaged_file_is_read_rightly_or_refused(draw: st.DataObject, plain: bool) -> None:
    whole = PLAIN.encode() if plain else write_nuke(two_levels())
    start = draw.draw(st.integers(0, len(whole)))
    length = draw.draw(st.sampled_from([0, 1, 2, 10, 1000]))
    damaged = whole[:start] + draw.draw(st.binary(max_size=4)) + whole[start + length :]
    try:
        table = read_nuke(damaged)
    except BadDocument as error:
        assert "\n" not in str(error)  # noqa: PT017 either outcome is right
    else:
        assert len(table.levels) == 1 if plain else len(table.levels) in (1, 2)
