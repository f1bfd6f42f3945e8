"""``python -m engine_adapters.sim``: the simulated studio, to be started as a process of its own on any system."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from engine_adapters.sim.camera_output import PayloadStyle, PictureFormat
from engine_adapters.sim.process import SimulatorOptions, main
from engine_adapters.sim.room import RoomKind


def parse_options(arguments: list[str] | None = None) -> SimulatorOptions:
    """The options of a command line (None: this process's own); exits with 2 for a wrong one."""
    default = SimulatorOptions()
    parser = argparse.ArgumentParser(prog="python -m engine_adapters.sim", description=__doc__)
    parser.add_argument("--lens-file", type=Path, help="truth file of the lens")
    parser.add_argument("--lens", default=default.lens, help="embedded lens (default: %(default)s)")
    parser.add_argument("--r3-port", type=int, default=default.r3_port, help="0: any free port")
    parser.add_argument("--mockboard-port", type=int, default=default.mockboard_port)
    parser.add_argument("--head-port", type=int, default=default.head_port)
    parser.add_argument("--room", type=RoomKind, choices=list(RoomKind), default=default.room)
    parser.add_argument("--delay-frames", type=int, default=default.delay_frames, help="from a change to its picture")
    parser.add_argument("--picture-time-ms", type=float, default=default.picture_time_ms)
    parser.add_argument("--payload", type=PayloadStyle, choices=list(PayloadStyle), default=default.payload)
    parser.add_argument(
        "--payload-format", type=PictureFormat, choices=list(PictureFormat), default=default.payload_format
    )
    parser.add_argument("--head-speed", type=float, default=default.head_speed_deg_s, help="degrees a second")
    parser.add_argument("--seed", type=int, default=default.seed, help="of the noise")
    parser.add_argument("--fault", action="append", default=[], metavar="SPEC", help="for example r3:late=0.5@3")
    parser.add_argument(
        "--engine", action="append", default=[], metavar="NAME=VALUE", help="radius_unit=half_width ..."
    )
    parser.add_argument("--exit-with-parent", action="store_true", help="end when standard input closes")
    given = parser.parse_args(arguments)
    if given.seed < 0:
        parser.error("--seed must not be negative")
    return SimulatorOptions(
        lens_file=given.lens_file,
        lens=given.lens,
        r3_port=given.r3_port,
        mockboard_port=given.mockboard_port,
        head_port=given.head_port,
        room=given.room,
        delay_frames=given.delay_frames,
        picture_time_ms=given.picture_time_ms,
        payload=given.payload,
        payload_format=given.payload_format,
        head_speed_deg_s=given.head_speed,
        seed=given.seed,
        faults=tuple(given.fault),
        engine=tuple(given.engine),
        exit_with_parent=given.exit_with_parent,
    )


if __name__ == "__main__":
    sys.exit(main(parse_options()))
