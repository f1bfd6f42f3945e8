"""Where a table comes from: what each way to make one fills in."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from app.bootstrap import load_engines
from app.engines import ProfileFacts
from app.jobs.provenance import imported, inputs_sha256, provenance_of_job, provenance_of_set, software
from calibration.tables import EvidenceSummary, LevelResult, Provenance
from engine_adapters.profile import StudioProfile, parse_profile, profile_sha256
from storage.exports import EXPORTS
from storage.exports.base import read_table
from tests.support.service import lens_table, measured_level

SUMMARY = EvidenceSummary(0.01, "side.png", 0.5, 0.8, 0.9, None, None, None, (), "ab" * 32)


def _with_evidence(zoom: float, sha256: str) -> LevelResult:
    return replace(measured_level(zoom), evidence=replace(SUMMARY, inputs_sha256=sha256))


def test_the_inputs_hash_is_over_the_levels_in_their_order() -> None:
    one, two = _with_evidence(0.0, "aa"), _with_evidence(0.5, "bb")
    assert inputs_sha256([one, LevelResult.failed(0.2, 0.0, "dark"), two]) == hashlib.sha256(b"aa\nbb\n").hexdigest()
    assert inputs_sha256([two, one]) != inputs_sha256([one, two])
    assert inputs_sha256([measured_level()]) is None


def test_a_job_names_itself_and_its_profile() -> None:
    told = provenance_of_job("job-1", [_with_evidence(0.0, "aa")], ProfileFacts("studio", "cd" * 32))
    assert told == Provenance(
        "calibrated", software(), "job-1", "studio", "cd" * 32, hashlib.sha256(b"aa\n").hexdigest()
    )
    assert provenance_of_job("job-1", [measured_level()], None).profile_sha256 is None


def test_a_set_without_evidence_is_known_by_its_pictures() -> None:
    assert provenance_of_set([measured_level()], "ef" * 32).inputs_sha256 == "ef" * 32
    told = provenance_of_set([_with_evidence(0.0, "aa")], "ef" * 32)
    assert (told.inputs_sha256, told.job_id) == (hashlib.sha256(b"aa\n").hexdigest(), None)


def test_engines_know_the_profiles_of_their_files(tmp_path: Path) -> None:
    text = "[r3]\nport = 9010\n"
    paths = [tmp_path / "stage 1.toml", tmp_path / "stage 2.toml"]
    for path in paths:
        path.write_text(text, "utf-8")
    engines = load_engines(paths)
    assert engines.profile("default") == ProfileFacts("stage 1", profile_sha256(parse_profile(text)))
    second = engines.profile("stage 2")
    assert second is not None
    assert second.name == "stage 2"
    assert load_engines([]).profile("default") == ProfileFacts("defaults", profile_sha256(StudioProfile()))


def test_an_imported_table_names_its_file_and_its_parent() -> None:
    table = replace(lens_table(), provenance=Provenance("calibrated", "lensmatch 0.0.9", job_id="job-1"))
    for name in ("json", "csv"):
        data = EXPORTS[name].write(table)
        told = imported(EXPORTS[name].read(data), data, EXPORTS[name]).provenance
        assert told is not None
        assert (told.source, told.software, told.job_id) == ("imported", software(), None)
        assert told.inputs_sha256 == hashlib.sha256(data).hexdigest()
        assert told.parent_sha256 == hashlib.sha256(EXPORTS["json"].write(table)).hexdigest()
        assert told.note == f"read from a {name} file; calibrated by lensmatch 0.0.9, job job-1"
    bare = EXPORTS["json"].write(lens_table())
    told = imported(lens_table(), bare, EXPORTS["json"]).provenance
    assert told is not None
    assert told.note == "read from a json file"


def test_a_file_of_another_program_has_no_parent() -> None:
    def read(software: str) -> Provenance | None:
        made = datetime(2026, 11, 21, tzinfo=UTC)
        table = read_table(
            b"data",
            "LENS",
            [measured_level()],
            lens="L",
            camera="C",
            created=made,
            image_size=(1920, 1080),
            software=software,
        )
        return imported(table, b"data", EXPORTS["json"]).provenance

    told, unknown = read("Other 4.2"), read("unknown")
    assert told is not None
    assert unknown is not None
    assert (told.parent_sha256, told.software) == (None, software())
    assert told.note == "read from a LENS file, written by Other 4.2"
    assert unknown.note == "read from a LENS file"
