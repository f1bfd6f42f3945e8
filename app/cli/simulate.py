"""``lensmatch simulate``: the simulated studio alone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.cli.console import reported_errors, wrong_usage
from engine_adapters.sim.camera_output import PayloadStyle, PictureFormat
from engine_adapters.sim.engine_camera import EngineCamera
from engine_adapters.sim.errors import SimulatorError
from engine_adapters.sim.faults import parse_fault
from engine_adapters.sim.lens_truth import embedded_lens_names
from engine_adapters.sim.process import SimulatorOptions, main
from engine_adapters.sim.room import RoomKind

_DEFAULT = SimulatorOptions()


def simulate(
    lens_file: Annotated[Path | None, typer.Option(help="truth file of the lens")] = _DEFAULT.lens_file,
    lens: Annotated[str, typer.Option(help="embedded lens, where no file is given")] = _DEFAULT.lens,
    r3_port: Annotated[int, typer.Option(min=0, max=65535, help="of R3; 0: any free one")] = _DEFAULT.r3_port,
    mockboard_port: Annotated[int, typer.Option(min=0, max=65535, help="of the MockBoard")] = _DEFAULT.mockboard_port,
    head_port: Annotated[int, typer.Option(min=0, max=65535, help="of the camera head")] = _DEFAULT.head_port,
    room: Annotated[RoomKind, typer.Option(help="what stands in the room")] = _DEFAULT.room,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SPEC",
            help="TARGET:KIND[=VALUE]@WHICH, repeatable. TARGET r3 or mockboard; KIND drop, late=SECONDS, split, "
            "garbage, disconnect, for r3 clip=LIMIT, for mockboard stale, status=CODE; WHICH the number of the "
            "exchange, a range 4..6, or * for each",
        ),
    ] = None,
    engine: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="how the engine reads its exports, repeatable: radius_unit, direction, center_shift, pixel_centres, "
            "center_shift_sign_x, center_shift_sign_y, fov_axis, fov_unit, nodal_unit, nodal_sign as in the studio "
            "profile; distortion_sign, overscan and pixel_aspect besides",
        ),
    ] = None,
    delay_frames: Annotated[
        int, typer.Option(min=0, max=120, help="frames from a change to the picture that shows it")
    ] = _DEFAULT.delay_frames,
    picture_time_ms: Annotated[float, typer.Option(min=0, help="time of a picture")] = _DEFAULT.picture_time_ms,
    payload: Annotated[PayloadStyle, typer.Option(help="how the MockBoard wraps a picture")] = _DEFAULT.payload,
    payload_format: Annotated[PictureFormat, typer.Option(help="its picture file")] = _DEFAULT.payload_format,
    head_speed: Annotated[float, typer.Option(min=0, help="of the head, degrees a second")] = _DEFAULT.head_speed_deg_s,
    seed: Annotated[int, typer.Option(min=0, help="of the noise")] = _DEFAULT.seed,
    exit_with_parent: Annotated[
        bool, typer.Option("--exit-with-parent", help="end when standard input closes")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="as every command has it; the addresses are JSON either way")
    ] = False,
) -> None:
    """Run the simulated studio alone: R3 on TCP, MockBoard and camera head on HTTP, on this machine only.

    Prints one line of JSON with its addresses when it is ready, then runs until Ctrl-C.
    """
    with reported_errors(as_json):
        if lens_file is None and lens not in embedded_lens_names():
            wrong_usage(f"no embedded lens is called {lens!r}; there are: {', '.join(embedded_lens_names())}")
        try:
            EngineCamera.parse(tuple(engine or ()))
        except SimulatorError as error:
            wrong_usage(str(error))
        for spec in fault or ():
            try:
                parse_fault(spec)
            except SimulatorError as error:
                wrong_usage(str(error))
    options = SimulatorOptions(
        lens_file=lens_file,
        lens=lens,
        r3_port=r3_port,
        mockboard_port=mockboard_port,
        head_port=head_port,
        room=room,
        delay_frames=delay_frames,
        picture_time_ms=picture_time_ms,
        payload=payload,
        payload_format=payload_format,
        head_speed_deg_s=head_speed,
        seed=seed,
        faults=tuple(fault or ()),
        engine=tuple(engine or ()),
        exit_with_parent=exit_with_parent,
    )
    with reported_errors(as_json):
        raise typer.Exit(main(options))
