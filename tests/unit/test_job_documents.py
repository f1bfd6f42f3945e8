"""Jobs of every kind as documents: told apart by ``kind``, and each mistake in one line that names its field."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from typing import Any

import pytest
from pydantic import ValidationError

from app.documents import JobRequest, one_line
from app.job_documents import KINDS, PublishOptions, PublishRequest, kind_of, parse_job
from storage.schemas import table_to_document
from tests.support.service import JOB, lens_table

PUBLISH: dict[str, Any] = {"kind": "publish", "table_id": 3}
RECHECK: dict[str, Any] = {"kind": "recheck", "table_id": 3}
ROOM: dict[str, Any] = {"targets": JOB["targets"], "pivot_m": JOB["pivot_m"]}


def test_a_job_stored_before_there_were_kinds_is_a_calibration() -> None:
    assert "kind" not in JOB
    job = parse_job(JOB)
    assert isinstance(job, JobRequest)
    assert kind_of(JOB) == job.kind == "calibrate"
    again = parse_job(json.loads(json.dumps(job.model_dump(mode="json"))))
    assert again == job


@pytest.mark.parametrize("name", list(KINDS))
def test_each_kind_says_its_own_name(name: str) -> None:
    assert KINDS[name].model_fields["kind"].annotation is not None
    document = {"calibrate": {**JOB, "kind": "calibrate"}, "publish": PUBLISH, "recheck": RECHECK}[name]
    assert parse_job(document).kind == name


def test_a_publish_job_keeps_its_table_to_the_last_digit() -> None:
    table = lens_table()
    job = parse_job({"kind": "publish", "table": table_to_document(table), "zoom": 0.0, "focus": 0.0, **ROOM})
    again = parse_job(json.loads(json.dumps(job.model_dump(mode="json"))))
    assert isinstance(again, PublishRequest)
    assert again == job
    assert again.to_table() == table
    assert again.place == (0.0, 0.0)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda d: d.update(kind="explode"), "kind 'explode' is not known; there are calibrate, publish, recheck"),
        (lambda d: d.update(kind=["publish"]), "is not known"),
        (lambda d: d.pop("table_id"), "give either table_id or table"),
        (lambda d: d.update(table=table_to_document(lens_table())), "give either table_id or table"),
        (lambda d: d.update(table_id=0), "table_id: "),
        (lambda d: d.update(zoom=0.5), "zoom and focus are given together"),
        (lambda d: d.update(zoom=1.5, focus=0.5), "zoom: "),
        (lambda d: d.update(zoom=float("nan"), focus=0.5), "zoom: "),
        (lambda d: d.update(pivot_m=[0, 0, 1.5]), "targets and pivot_m are given together"),
        (lambda d: d.update(targets=ROOM["targets"]), "targets and pivot_m are given together"),
        (lambda d: d.update(ROOM | {"pivot_m": [0, 9, 1.5]}), "turns its back to the camera"),
        (lambda d: d.update(limit_px=0), "limit_px: "),
        (lambda d: d.update(lens="XA 20x"), "lens: "),
        (lambda d: d.update(engine=" "), "engine: must be printable"),
        (lambda d: d.update(job=2), "job: "),
    ],
)
def test_a_publish_job_with_a_mistake_is_refused(change: Callable[[dict[str, Any]], object], told: str) -> None:
    document = copy.deepcopy(PUBLISH)
    change(document)
    with pytest.raises(ValidationError) as error:
        parse_job(document)
    assert told in one_line(error.value)
    assert "\n" not in one_line(error.value)


def test_a_table_that_contradicts_itself_is_refused_with_its_field() -> None:
    document = table_to_document(lens_table())
    document["levels"][0]["f_px"] *= 2
    with pytest.raises(ValidationError) as error:
        parse_job({"kind": "publish", "table": document})
    assert "f_px of level zoom 0, focus 0" in one_line(error.value)


def test_the_options_are_the_job_without_its_table() -> None:
    assert set(PublishRequest.model_fields) - set(PublishOptions.model_fields) == {"job", "kind", "table_id", "table"}


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"table": table_to_document(lens_table())}, "give either table_id or table"),
        ({"table_id": None}, "give either table_id or table"),
        ({"table_id": None, "table": table_to_document(lens_table()), "store": True}, "store needs table_id"),
        ({"pivot_m": [0, 0, 1.5]}, "targets and pivot_m are given together"),
        ({"pivot_sigma_m": 0.002}, "pivot_sigma_m is given together with targets"),
        ({"priors": {"pan_scale": 0.1}}, "priors is given together with targets"),
        ({"levels": [{"zoom": 0.5, "focus": 0.5}] * 2}, "is listed twice"),
        ({"levels": [{"zoom": 1.5, "focus": 0.5}]}, "levels.0.zoom: "),
        ({"goal_px": 0}, "goal_px: "),
        ({"goal_px": float("nan")}, "goal_px: "),
        ({"zoom": 0.5}, "zoom: "),
    ],
)
def test_a_wrong_recheck_is_one_line(change: dict[str, Any], told: str) -> None:
    with pytest.raises(ValidationError) as caught:
        parse_job({**RECHECK, **change})
    assert told in one_line(caught.value)


def test_a_start_is_an_id_or_a_whole_table() -> None:
    document = table_to_document(lens_table())
    for start in (3, document):
        job = parse_job({**JOB, "start_from": start})
        again = parse_job(json.loads(json.dumps(job.model_dump(mode="json"))))
        assert isinstance(again, JobRequest)
        assert again == job
    for wrong in (0, -1, {**document, "levels": []}):
        with pytest.raises(ValidationError):
            parse_job({**JOB, "start_from": wrong})
