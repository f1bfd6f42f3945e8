"""What stands in the simulated room, and the operator's survey of it."""

from __future__ import annotations

import numpy as np
import pytest

from engine_adapters.sim.room import Panel, RoomKind, build_room

RED = (34, 28, 196)


@pytest.mark.parametrize(
    ("turn", "right", "down", "normal"),
    [
        ({}, (1, 0, 0), (0, 0, -1), (0, -1, 0)),
        ({"yaw_deg": 90.0}, (0, 1, 0), (0, 0, -1), (1, 0, 0)),
        ({"pitch_deg": 90.0}, (1, 0, 0), (0, 1, 0), (0, 0, -1)),
        ({"roll_deg": 90.0}, (0, 0, -1), (-1, 0, 0), (0, -1, 0)),
        # Intrinsic: the roll turns about the normal that yaw has moved.
        ({"yaw_deg": 90.0, "roll_deg": 90.0}, (0, 0, -1), (0, -1, 0), (1, 0, 0)),
    ],
)
def test_panels_turn_about_z_x_y_right_handed(
    turn: dict[str, float], right: tuple[int, ...], down: tuple[int, ...], normal: tuple[int, ...]
) -> None:
    yaw, pitch, roll = (turn.get(name, 0.0) for name in ("yaw_deg", "pitch_deg", "roll_deg"))
    centre = (0.0, 5.0, 1.6)
    panel = Panel("p", (1, 1), (1.0, 1.0), (RED, RED), centre, yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)
    assert panel.axes == pytest.approx(np.array([right, down, normal], dtype=float), abs=1e-12)


def test_the_survey_is_a_picture_sets_targets() -> None:
    survey = build_room().survey()
    assert survey["pivot_m"] == [0.0, 0.0, 1.6]
    large, small = survey["targets"]["board_large"], survey["targets"]["board_small"]
    assert (large["kind"], large["squares"], large["square_m"]) == ("chessboard", [9, 7], 0.1)
    assert (small["kind"], small["squares"], small["square_m"]) == ("chessboard", [8, 6], 0.03)
    assert (large["colours"], small["colours"]) == (["red", "white"], ["red", "black"])
    assert large["pose"] == {"centre_m": [-0.6, 5.0, 1.6], "yaw_deg": 0.0, "pitch_deg": 0.0, "roll_deg": 0.0}
    assert small["pose"]["centre_m"] == [0.35, 5.0, 1.6]


def test_the_other_rooms_have_squares_or_a_light() -> None:
    squares = build_room(RoomKind.SQUARE).survey()["targets"]
    assert {name: target["size_m"] for name, target in squares.items()} == {
        "square_large": [0.6, 0.6],
        "square_small": [0.18, 0.18],
    }
    lit = build_room(RoomKind.LIGHT).survey()["targets"]
    assert lit["light"]["kind"] == "light"
    assert lit["light"]["diameter_m"] == 0.01
    assert "board_large" in lit
