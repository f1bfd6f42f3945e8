"""The operator at the terminal: what they are asked and how their answers are read."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from app.cli.operator import TerminalOperator, answered
from engine_adapters.errors import Refused
from engine_adapters.head.operator import OperatorHead
from engine_adapters.ports import HeadState


def typing_person(*lines: str) -> Callable[[], str]:
    answers = iter(lines)
    return lambda: next(answers, "")


def head(*lines: str) -> OperatorHead:
    return OperatorHead(TerminalOperator(typing_person(*lines)).ask, answer_timeout_s=10)


async def test_enter_confirms_what_the_head_asks_for() -> None:
    asked = head("0 0 0 0.5 0.25\n", "\n", "\n")
    assert await asked.read() == HeadState(0, 0, 0, 0.5, 0.25)
    assert await asked.set_lens(zoom=0.75, focus=0.125) == HeadState(0, 0, 0, 0.75, 0.125)
    assert await asked.move_to(pan_deg=-14.5, tilt_deg=2.25) == HeadState(-14.5, 2.25, 0, 0.75, 0.125)


async def test_what_the_encoders_show_wins() -> None:
    asked = head("1,2,0,0.5,0.25\n", "pan=3.01 tilt=-0.5\n")
    await asked.read()
    assert await asked.move_to(pan_deg=3, tilt_deg=0) == HeadState(3.01, -0.5, 0, 0.5, 0.25)


async def test_a_wrong_answer_is_asked_again(capsys: pytest.CaptureFixture[str]) -> None:
    asked = head("\n", "somewhere\n", "0 0 0 0.5 0.25\n")
    assert await asked.read() == HeadState(0, 0, 0, 0.5, 0.25)
    told = capsys.readouterr()
    assert "pan, tilt, roll, zoom, focus not known yet" in told.err
    assert "'somewhere' is not understood" in told.err
    assert told.out == ""


@pytest.mark.parametrize("line", ["q\n", "Quit\n", ""])
async def test_declining_and_the_end_of_input_refuse(line: str) -> None:
    with pytest.raises(Refused, match="declined"):
        await head(line).move_to(pan_deg=1, tilt_deg=0)


@pytest.mark.parametrize("line", ["pan=nan", "1 2 3", "pan=1 2", "zoom", "1e400 0 0 0 0"])
def test_what_is_no_answer_is_said(line: str) -> None:
    assert isinstance(answered(line, "pan 1.000, tilt 2.000", {}), str)
