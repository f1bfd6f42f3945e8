"""OpenTrackIO: the test vector in its units, its own schema, its own examples, round trips and bad files."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.compare import overlay
from calibration.lens import Lens
from calibration.tables import LensTable, LevelResult, LevelStatus
from storage.errors import BadDocument, CannotExport
from storage.exports import EXPORTS, Export
from tests.support.real_lenses import (
    SENSOR_MM,
    SIZE,
    VECTOR,
    assert_same_lenses,
    level_of,
    real_tables,
    table_of,
    vector_table,
)

UD, DU = EXPORTS["opentrackio"], EXPORTS["opentrackio-du"]
BOTH = pytest.mark.parametrize("export", [UD, DU], ids=["U-D", "D-U"])


@pytest.fixture(scope="session")
def standard(shared_data: Path) -> Path:
    """The folder with the standard's own schema and examples."""
    folder = shared_data.parent / "protocols" / "opentrackio"
    if not (folder / "schema.json").is_file():
        pytest.skip(f"no OpenTrackIO schema at {folder}: set LENSMATCH_SHARED to the folder that holds protocols/")
    return folder


@pytest.fixture(scope="session")
def validator(standard: Path) -> jsonschema.Draft202012Validator:
    return jsonschema.Draft202012Validator(json.loads((standard / "schema.json").read_text("utf-8")))


def samples_of(export: Export, table: LensTable) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(export.write(table))
    return found


def foreign() -> dict[str, Any]:
    """The test vector's sample without this program's own key."""
    (sample,) = samples_of(UD, vector_table())
    del sample["lensmatch"]
    return sample


def read(document: object) -> LensTable:
    return UD.read(json.dumps(document).encode())


def lens_of(table: LensTable, level: int = 0) -> Lens:
    return table.levels[level].lens(table.image_size, table.pixel_aspect)


# Golden values


def test_the_test_vector_in_millimetres() -> None:
    (sample,) = samples_of(UD, vector_table())
    lens = sample["lens"]
    assert lens["pinholeFocalLength"] == pytest.approx(9.199, abs=1e-8)
    radial = pytest.approx([-0.00226442182, 0, 9.63534131e-06])
    assert lens["distortion"] == [{"model": "Brown-Conrady U-D", "radial": radial}]
    # The vector's own -0.013736296 mm comes from the rounded sensor height, 0.5 um over the whole of it.
    assert lens["projectionOffset"] == pytest.approx({"x": 0.020604375, "y": -0.013736296}, abs=5e-8)
    assert lens["encoders"] == {"focus": 0.5, "zoom": 0.0}
    size = sample["static"]["camera"]["activeSensorPhysicalDimensions"]
    assert (size["width"], size["height"]) == (SENSOR_MM[0], pytest.approx(SENSOR_MM[1], abs=1e-4))
    assert sample["static"]["camera"]["activeSensorResolution"] == {"width": 1920, "height": 1080}


def test_a_ray_lands_where_the_standards_equations_put_it() -> None:
    """Equations 9 to 13 written out, for the ray (0.5, 0.2) of the test vector."""
    (sample,) = samples_of(UD, vector_table())
    lens, camera = sample["lens"], sample["static"]["camera"]
    focal_mm = lens["pinholeFocalLength"]
    x, y = 0.5 * focal_mm, 0.2 * focal_mm
    assert (x, y) == pytest.approx((4.5995, 1.8398), abs=1e-7)
    k1, k2, k3 = lens["distortion"][0]["radial"]
    r2 = x * x + y * y
    gain = (1 + k1 * r2 + k3 * r2 * r2) / (1 + k2 * r2)
    assert (x * gain, y * gain) == pytest.approx((4.370597278, 1.748238911), abs=1e-8)
    sensor, pixels = camera["activeSensorPhysicalDimensions"], camera["activeSensorResolution"]
    u = (x * gain + lens["projectionOffset"]["x"]) * pixels["width"] / sensor["width"] + pixels["width"] / 2 - 0.5
    v = (y * gain + lens["projectionOffset"]["y"]) * pixels["height"] / sensor["height"] + pixels["height"] / 2 - 0.5
    assert (u, v) == pytest.approx((1598.859600, 792.043840), abs=1e-6)


def test_the_default_model_undoes_the_distortion() -> None:
    """Equation 17 with the file's own numbers brings the test vector's distorted point back to its ray."""
    (sample,) = samples_of(DU, vector_table())
    k = [*sample["lens"]["distortion"][0]["radial"], 0, 0, 0, 0, 0][:6]
    assert sample["lens"]["distortion"][0]["model"] == "Brown-Conrady D-U"
    x, y = 4.370597278, 1.748238911
    r2 = x * x + y * y
    gain = (1 + k[0] * r2 + k[2] * r2**2 + k[4] * r2**3) / (1 + k[1] * r2 + k[3] * r2**2 + k[5] * r2**3)
    px_per_mm = SIZE[0] / SENSOR_MM[0]
    assert (x * gain * px_per_mm, y * gain * px_per_mm) == pytest.approx(
        (4.5995 * px_per_mm, 1.8398 * px_per_mm), abs=1e-3
    )
    refit = sample["lensmatch"]["refit_px"]
    assert 0 < refit["rms"] < refit["max"] < 1e-3


def test_the_pupil_is_not_told_from_the_wrong_place() -> None:
    (sample,) = samples_of(UD, vector_table())
    assert "entrancePupilOffset" not in sample["lens"]
    assert sample["lensmatch"]["level"]["nodal_offset_mm"] == 121.3
    assert any("entrancePupilOffset" in lost for lost in UD.cannot_carry)


def test_the_refit_is_told_to_the_operator() -> None:
    assert DU.advice is not None
    assert "max 0.00047 px at zoom 0, focus 0.5" in DU.advice(vector_table())
    assert UD.advice is None


# The standard's own schema and examples


@BOTH
@settings(max_examples=15)
@given(table=real_tables())
def test_every_sample_is_valid_alone(
    export: Export, validator: jsonschema.Draft202012Validator, table: LensTable
) -> None:
    samples = samples_of(export, table)
    assert len(samples) == len(table.levels)
    for sample in samples:
        validator.validate(sample)
    assert len({sample["sampleId"] for sample in samples}) == len(samples)


def test_the_schema_would_find_a_mistake(validator: jsonschema.Draft202012Validator) -> None:
    (sample,) = samples_of(UD, vector_table())
    sample["lens"]["nodalOffset"] = 1
    assert not validator.is_valid(sample)


def test_a_sample_of_another_program_is_read(standard: Path) -> None:
    table = UD.read((standard / "our_example_udp_sample.json").read_bytes())
    (level,) = table.levels
    assert (table.lens, table.camera) == ("Sony RX10III (lensfun, CC BY-SA 3.0)", "CAM1")
    assert (level.zoom, level.focus, level.nodal_offset_mm) == (0.0, 0.0, None)
    assert "not in the OpenTrackIO file" in level.reasons["nodal_offset_mm"]
    assert table.pixel_aspect == 1.0
    lens = Lens(SIZE, VECTOR.f_px, VECTOR.k1, VECTOR.k2, lens_of(table).center_shift_px)
    assert overlay(lens, lens_of(table)).max_px < 1e-4
    assert lens.center_shift_px == pytest.approx((3.06, -1.89), abs=0.01)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        # Their numbers are place holders (coefficients of 1 to 6, offsets of 1 mm and 2 mm), and few have a static
        # block with the picture's size.
        ("complete_static_example.json", r"lens.distortionOffset: is not 0"),
        ("recommended_static_example.json", "static.camera.activeSensorResolution: field required"),
        ("complete_dynamic_example.json", "static: is missing: sensor and picture size"),
        ("recommended_dynamic_example.json", "static: is missing: sensor and picture size"),
    ],
)
def test_the_official_examples_are_refused_for_what_they_hold(standard: Path, name: str, words: str) -> None:
    with pytest.raises(BadDocument, match=words):
        UD.read((standard / name).read_bytes())


def test_an_official_example_with_possible_numbers_is_read(standard: Path) -> None:
    example = json.loads((standard / "complete_static_example.json").read_bytes())
    example["lens"]["distortionOffset"] = {"x": 0, "y": 0}
    example["lens"]["distortion"] = [{"radial": [1e-4, 2e-5], "tangential": [0, 0], "overscan": 1.1}]
    table = read(example)
    assert (table.lens, table.camera) == ("LensMaker Model15", "A")
    assert table.levels[0].k1 == pytest.approx(-(1e-4 - 2e-5) * 24.305**2, rel=0.05)


# There and back


@BOTH
@settings(max_examples=25)
@given(table=real_tables())
def test_there_and_back(export: Export, table: LensTable) -> None:
    back = export.read(export.write(table))
    assert_same_lenses(table, back, 1e-9 if export is UD else 5e-3)
    assert back.provenance is not None
    assert ("refitted" in str(back.provenance.note)) == (
        export is DU and any(level.k1 is not None or level.k2 is not None for level in table.levels)
    )


@BOTH
def test_the_same_table_gives_the_same_bytes(export: Export) -> None:
    assert export.write(vector_table()) == export.write(vector_table())


def test_the_test_vector_comes_back_through_the_default_model() -> None:
    back = DU.read(DU.write(vector_table()))
    assert overlay(VECTOR, lens_of(back)).max_px < 1e-6


def test_a_sample_taken_out_of_its_file_is_read() -> None:
    table = table_of(level_of(VECTOR), level_of(VECTOR, 0.5))
    back = read(samples_of(UD, table)[1])
    assert [level.zoom for level in back.levels] == [0.5]
    with pytest.raises(BadDocument, match="1 levels of the 2"):
        read(samples_of(UD, table)[:1])


def test_a_failed_level_is_left_out_and_a_degraded_one_stays() -> None:
    degraded = LevelResult.from_lens(
        0.5,
        0.5,
        VECTOR,
        status=LevelStatus.DEGRADED,
        reason="two pictures only",
        reasons=level_of(VECTOR).reasons,
    )
    back = UD.read(UD.write(table_of(LevelResult.failed(0, 0.5, "no board"), degraded)))
    (level,) = back.levels
    assert (level.status, level.reason) == (LevelStatus.DEGRADED, "two pictures only")


def test_a_coarse_map_of_another_program_degrades_its_level() -> None:
    sample = foreign()
    sample["lens"]["distortion"] = [{"radial": [0.00249998306, 0, -3.9107012e-06]}]
    table = read(sample)
    (level,) = table.levels
    assert level.status is LevelStatus.DEGRADED
    assert "off by up to" in str(level.reason)
    assert overlay(VECTOR, lens_of(table)).max_px < 3


def test_the_exact_model_goes_before_the_default_one() -> None:
    sample = foreign()
    sample["lens"]["distortion"].insert(0, {"radial": [0.0025]})
    assert lens_of(read(sample)).k1 == pytest.approx(VECTOR.k1, rel=1e-12)


def test_the_static_block_holds_for_the_samples_after_it() -> None:
    first, second = foreign(), foreign()
    second["lens"]["encoders"]["zoom"] = 1.0
    del second["static"]
    assert [level.zoom for level in read([first, second]).levels] == [0.0, 1.0]


def test_what_a_sample_does_not_tell_is_not_told() -> None:
    sample = foreign()
    del sample["lens"]["distortion"], sample["lens"]["projectionOffset"]
    (level,) = read(sample).levels
    assert (level.k1, level.k2, level.center_shift_px) == (None, None, None)


# What cannot be written


def test_tables_that_cannot_be_carried() -> None:
    failed = LevelResult.failed(0, 0, "no board")
    no_sensor = LensTable("a", "b", 1, vector_table().created, SIZE, "joint", (level_of(VECTOR),))
    folded = Lens(SIZE, 1000.0, k1=-0.5)
    for table, words in (
        (table_of(failed), "no level of this table has a field of view"),
        (no_sensor, "sensor_mm"),
        (table_of(level_of(VECTOR, zoom=4096.0)), "at zoom 4096"),
        (table_of(level_of(VECTOR, focus=-0.1)), "at focus -0.1"),
        (table_of(level_of(folded)), "folds inside the picture"),
    ):
        for export in (UD, DU):
            with pytest.raises(CannotExport, match=words):
                export.write(table)


# Bad files

Change = Callable[[dict[str, Any]], object]


@pytest.mark.parametrize(
    ("change", "field", "words"),
    [
        (lambda s: s.pop("protocol"), "protocol.name", "is not OpenTrackIO"),
        (lambda s: s["protocol"].update(name="OpenLensIO"), "protocol.name", "is not OpenTrackIO"),
        (lambda s: s["protocol"].update(version=[1, 0, 0]), "protocol.version", "reads \\[1, 0, 1\\]"),
        (lambda s: s["protocol"].update(version="1.0.1"), "protocol.version", "is 1.0.1"),
        (lambda s: s.pop("static"), "static", "is missing"),
        (lambda s: s.pop("lens"), "lens", "required"),
        (lambda s: s["lens"].pop("encoders"), "lens.encoders", "required"),
        (lambda s: s["lens"]["encoders"].pop("focus"), "lens.encoders.focus", "required"),
        (lambda s: s["lens"]["encoders"].update(zoom=1.5), "lens.encoders.zoom", "less than or equal to 1"),
        (lambda s: s["lens"]["encoders"].update(zoom=True), "lens.encoders.zoom", "valid number"),
        (lambda s: s["lens"].pop("pinholeFocalLength"), "lens.pinholeFocalLength", "required"),
        (lambda s: s["lens"].update(pinholeFocalLength=0), "lens.pinholeFocalLength", "greater than 0"),
        (lambda s: s["lens"].update(pinholeFocalLength="9"), "lens.pinholeFocalLength", "valid number"),
        (lambda s: s["lens"].update(undistortion=[1]), "lens.undistortion", "not permitted"),
        (lambda s: s["lens"].update(projectionOffset={"x": 1}), "lens.projectionOffset.y", "required"),
        (lambda s: s["lens"].update(distortionOffset={"x": 0.1, "y": 0}), "lens.distortionOffset", "one centre"),
        (lambda s: s["lens"].update(distortion=[]), "lens.distortion", "at least 1 item"),
        (lambda s: s["lens"]["distortion"][0].update(radial=[]), "lens.distortion[0].radial", "at least 1 item"),
        (lambda s: s["lens"]["distortion"][0].update(radial=[0] * 7), "lens.distortion[0].radial", "at most 6"),
        (lambda s: s["lens"]["distortion"][0].update(radial=[0, 1e-3]), "lens.distortion.radial", "first and third"),
        (lambda s: s["lens"]["distortion"][0].update(radial=[1e308]), "lens.distortion.radial", "finite"),
        (lambda s: s["lens"]["distortion"][0].update(tangential=[1e-5]), "lens.distortion", "tangential"),
        (lambda s: s["lens"]["distortion"][0].update(model="Fisheye"), "lens.distortion", "no model that is read"),
        (lambda s: s["lens"]["distortion"].append(s["lens"]["distortion"][0]), "lens.distortion", "twice"),
        (lambda s: s["lens"].update(distortion=[{"radial": [-0.03]}]), "lens.distortion.radial", "folds"),
        (lambda s: s["lens"].update(distortion=[{"radial": [0, -0.03]}]), "lens.distortion.radial", "pole"),
        (lambda s: s["lens"].update(distortion=[{"radial": [1e308, 1e308]}]), "lens.distortion.radial", "too large"),
        (lambda s: s["static"]["camera"].pop("activeSensorResolution"), "static.camera.activeSensorResolution", "req"),
        (
            lambda s: s["static"]["camera"]["activeSensorResolution"].update(width=10**9),
            "static.camera.activeSensorResolution.width",
            "100000",
        ),
        (
            lambda s: s["static"]["camera"].update(anamorphicSqueeze={"num": 2, "denom": 1}),
            "static.camera.anamorphicSqueeze",
            "anamorphic",
        ),
        (lambda s: s["static"]["lens"].update(model="x" * 500), "", "1 to 200"),
        (lambda s: s["lens"]["distortion"][0].update(radial=[-0.02]), "zoom 0, focus 0.5", "folds inside"),
    ],
)
def test_each_bad_field_is_named(change: Change, field: str, words: str) -> None:
    sample = foreign()
    change(sample)
    with pytest.raises(BadDocument, match=words) as raised:
        read(sample)
    assert raised.value.field == field
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: s["lensmatch"]["table"].update(lens_table=2), "lens_table"),
        (lambda s: s["lensmatch"]["table"].update(image_size=[3840, 2160]), "contradicts the sensor's size"),
        (lambda s: s["lensmatch"]["table"].update(pixel_aspect=1.01), "contradicts the sensor's size"),
        (lambda s: s["lensmatch"]["table"].update(created="yesterday"), "created"),
        (lambda s: s["lensmatch"]["level"].update(zoom=0.25), "contradicts the sample's lens"),
        (lambda s: s["lens"].pop("distortion"), "contradicts the sample's lens"),
        (lambda s: s["lens"].pop("projectionOffset"), "contradicts the sample's lens"),
        (lambda s: s["lensmatch"].pop("level"), "lensmatch.level"),
        (lambda s: s.update(lensmatch=5), "lensmatch"),
    ],
)
def test_a_note_that_contradicts_its_sample_is_refused(change: Change, words: str) -> None:
    (sample,) = samples_of(UD, vector_table())
    change(sample)
    with pytest.raises(BadDocument, match=words):
        read([sample])


def test_samples_that_contradict_each_other_are_refused() -> None:
    samples = samples_of(UD, table_of(level_of(VECTOR), level_of(VECTOR, 0.5)))
    with pytest.raises(BadDocument, match=r"twice"):
        read([samples[0], samples[0]])
    other = copy.deepcopy(samples)
    other[1]["static"]["camera"]["label"] = "Cam1"
    with pytest.raises(BadDocument, match=r"\[1\].static: differs"):
        read(other)
    del samples[1]["lensmatch"]
    with pytest.raises(BadDocument, match=r"\[1\].lensmatch.table: differs"):
        read(samples)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is not JSON"),
        ("[]", "neither a sample nor an array"),
        ("{}", "neither a sample nor an array"),
        ("17", "neither a sample nor an array"),
        ("[17]", "is not OpenTrackIO"),
        ('{"protocol": {"name": NaN}}', "holds NaN"),
        ('{"protocol": {}, "protocol": {}}', "twice"),
        ("[" * 100_000, "is not JSON"),
        ("[" + ",".join(["{}"] * 10_001) + "]", "has 10001 levels, at most 10000"),
    ],
)
def test_other_json_is_refused(text: str, words: str) -> None:
    with pytest.raises(BadDocument, match=words):
        UD.read(text.encode())


@BOTH
@settings(max_examples=100)
@given(data=st.data())
def test_a_damaged_file_is_read_rightly_or_refused(export: Export, data: st.DataObject) -> None:
    whole = export.write(table_of(level_of(VECTOR), level_of(VECTOR, 0.5)))
    start = data.draw(st.integers(0, len(whole)))
    length = data.draw(st.sampled_from([0, 1, 2, 10, 1000]))
    damaged = whole[:start] + data.draw(st.binary(max_size=4)) + whole[start + length :]
    try:
        table = export.read(damaged)
    except BadDocument as error:
        assert "\n" not in str(error)  # noqa: PT017 either outcome is right
    else:
        assert len(table.levels) == 2
