"""Fault specifications and the plan that deals them out."""

from __future__ import annotations

import pytest

from engine_adapters.sim.errors import SimulatorError
from engine_adapters.sim.faults import Fault, FaultKind, FaultPlan, FaultTarget, parse_fault


@pytest.mark.parametrize(
    ("spec", "fault"),
    [
        ("r3:drop@5", Fault(FaultTarget.R3, FaultKind.DROP, 5, 5)),
        ("r3:late=0.5@3", Fault(FaultTarget.R3, FaultKind.LATE, 3, 3, 0.5)),
        ("r3:split@*", Fault(FaultTarget.R3, FaultKind.SPLIT, 1, None)),
        ("r3:disconnect@7", Fault(FaultTarget.R3, FaultKind.DISCONNECT, 7, 7)),
        ("mockboard:stale@4..6", Fault(FaultTarget.MOCKBOARD, FaultKind.STALE, 4, 6)),
        ("r3:clip=0.05@*", Fault(FaultTarget.R3, FaultKind.CLIP, 1, None, 0.05)),
        ("mockboard:status=500@2", Fault(FaultTarget.MOCKBOARD, FaultKind.STATUS, 2, 2, 500.0)),
    ],
)
def test_specifications_are_read(spec: str, fault: Fault) -> None:
    assert parse_fault(spec) == fault


@pytest.mark.parametrize(
    ("spec", "told"),
    [
        ("", "TARGET:KIND"),
        ("r3:drop", "TARGET:KIND"),
        ("r3:drop@0", "from 1"),
        ("r3:drop@6..4", "upwards"),
        ("r3:drop@-1", "TARGET:KIND"),
        ("head:drop@1", "no server is called head"),
        ("r3:explode@1", "no fault is called explode"),
        ("r3:stale@1", "mockboard only"),
        ("mockboard:clip=0.1@1", "r3 only"),
        ("r3:clip=-1@1", "needs a value"),
        ("r3:drop=1@1", "takes no value"),
        ("r3:late@1", "needs a value"),
        ("r3:late=nan@1", "needs a value"),
        ("r3:late=-1@1", "needs a value"),
        ("mockboard:status=200@1", "needs a value"),
        ("mockboard:status=500.5@1", "needs a value"),
    ],
)
def test_wrong_specifications_are_refused_in_one_clear_line(spec: str, told: str) -> None:
    with pytest.raises(SimulatorError) as caught:
        parse_fault(spec)
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_plan_counts_each_server_for_itself() -> None:
    plan = FaultPlan(parse_fault(spec) for spec in ("r3:drop@2", "mockboard:late=1@1..2", "r3:split@*"))
    assert [fault.kind if (fault := plan.next(FaultTarget.R3)) else None for _ in range(3)] == [
        FaultKind.SPLIT,
        FaultKind.DROP,
        FaultKind.SPLIT,
    ]
    struck = [plan.next(FaultTarget.MOCKBOARD) for _ in range(3)]
    assert [fault is not None for fault in struck] == [True, True, False]
