"""Every R3 command of the study through our own client, on the simulated engine's socket."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from calibration.image import decode_picture
from engine_adapters.errors import Refused
from engine_adapters.profile import R3Settings
from engine_adapters.r3 import commands
from engine_adapters.r3.client import R3Client
from engine_adapters.sim.process import SimulatorOptions, simulated_studio

SCENE = "Lensmatch/Calibration"


async def test_all_seven_commands_are_understood_by_both_sides(tmp_path: Path) -> None:
    lens_file = tmp_path / "lens.json"
    levels = [{"zoom": 0.0, "focus": 0.5, "fov_x_deg": 60.0}]
    truth = {"lens_truth": 1, "lens": "T", "image_size": [320, 180], "sensor_mm": [9.6, 5.4], "levels": levels}
    lens_file.write_text(json.dumps(truth), "utf-8")
    quick = {"r3_port": 0, "mockboard_port": 0, "head_port": 0, "snapshot_time_s": 0.01}
    async with simulated_studio(SimulatorOptions(lens_file=lens_file, **quick)) as addresses:
        client = R3Client(R3Settings(**addresses["r3"]))
        try:
            with pytest.raises(Refused, match="COULD NOT READ"):
                await client.run(commands.get_snapshot("view"))
            await client.run(commands.take_snapshot("view"))
            picture = await client.run(commands.get_snapshot("view"))
            assert decode_picture(picture).shape == (180, 320, 3)

            await client.run(commands.set_value(SCENE, "lens.fov_x", "61.5"))
            assert await client.run(commands.get_value(SCENE, "lens.fov_x")) == "61.5"
            packet = await client.run(commands.get_tracking("Cam0"))
            assert packet["FOVX"] == 61.5
            assert packet["POSZ"] == 1.6

            await client.run(commands.multi_export(SCENE, [("lens.k1", "-0.125"), ("lens.k2", "0.03125")]))
            await client.run(commands.rename(SCENE, "lens.k2", "second"))
            assert await client.run(commands.get_value(SCENE, "second")) == "0.03125"
            with pytest.raises(Refused, match=r"1 of 2: lens\.k2.*NOT FOUND"):
                await client.run(commands.multi_export(SCENE, [("lens.k1", "0"), ("lens.k2", "0")]))
            assert await client.run(commands.get_value(SCENE, "lens.k1")) == "0"
        finally:
            await client.close()
