"""``lensmatch demo``: its document, its files, and what it reaches on one level."""

from __future__ import annotations

import json
from typing import Any

import pytest

from storage.exports import EXPORTS


@pytest.mark.slow
async def test_the_demo_tells_its_table_beside_the_truth_and_leaves_its_files(lensmatch: Any) -> None:
    out = lensmatch.folder / "demo"
    done = await lensmatch("demo", "--zooms", "1", "--focuses", "1", "--out", out, "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert {"table", "truth", "overlay_px", "pictures", "seconds"} <= told.keys()
    (level,) = told["table"]["levels"]
    assert level["status"] == "ok"
    assert 0 < told["overlay_px"]["rms"] <= told["overlay_px"]["max"] <= 0.15
    assert 0 < told["pictures"] <= 16
    assert told["truth"]["lens_truth"] == 1
    assert "demo 100%" in done.stderr

    files = {path.name: path for path in out.iterdir()}
    assert {"lens-table.json", "lens-table.csv", "report.html"} <= files.keys()
    table = EXPORTS["json"].read(files["lens-table.json"].read_bytes())
    assert json.loads(files["lens-table.json"].read_bytes()) == told["table"]
    assert table.provenance is not None
    assert (table.provenance.source, table.provenance.profile) == ("calibrated", "simulated studio")
    assert EXPORTS["csv"].read(files["lens-table.csv"].read_bytes()) == table
    report = files["report.html"].read_text("utf-8")
    assert "truth" in report
    assert report.count("data:image/") >= 2, "pictures of before and after"
