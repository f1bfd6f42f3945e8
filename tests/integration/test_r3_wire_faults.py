"""The R3 socket at its worst: cut, sliced, silent, garbled, out of order; each a typed error or the right result."""

from __future__ import annotations

import asyncio
import base64
import time
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine_adapters.errors import (
    AdapterError,
    BadPicture,
    ProtocolError,
    Refused,
    TimedOut,
    Unreachable,
)
from engine_adapters.ports import LensValues, Shown
from engine_adapters.profile import StudioProfile
from engine_adapters.r3 import commands
from engine_adapters.r3.client import R3Client, R3Engine, R3Snapshots
from engine_adapters.r3.protocol import Command
from engine_adapters.retry import classify_r3, retry
from tests.support.scripted_r3 import (
    PNG,
    SCENE,
    VALUE_SET,
    client_of,
    echo_value,
    replying,
    scripted,
    settings_for,
    value_reply,
)

TRACKING = b'OK: CURRENT CAMERA PARAMETERS:\n{"FovX": 80.0,\n "PosX": 1, "PosY": -2.5, "PosZ": 1e-1}\n'
PICTURE = b"OK: <IMAGE> " + base64.b64encode(PNG[:300] + PNG[-12:]) + b" <IMAGE>\r\n"
FAILING: list[Command[Any]] = [
    commands.take_snapshot("a"),
    commands.get_tracking("Cam0"),
    commands.get_snapshot("a"),
]
REPLIES: list[tuple[str, Command[Any], bytes]] = [
    ("value", commands.get_value(SCENE, "a"), value_reply("0.5")),
    ("multi", commands.multi_export(SCENE, [("a", "1"), ("b", "2")]), f"{VALUE_SET}\n{VALUE_SET}\n".encode()),
    ("tracking", commands.get_tracking("Cam0"), TRACKING),
    ("picture", commands.get_snapshot("a"), PICTURE),
    ("error", commands.take_snapshot("a"), "ERROR: SNAPSHOT – INVALID PATH\n".encode()),
]


@pytest.mark.parametrize(("command", "reply"), [case[1:] for case in REPLIES], ids=[case[0] for case in REPLIES])
async def test_a_reply_cut_at_every_byte_is_a_lost_connection(command: Command[Any], reply: bytes) -> None:
    cuts = iter(range(len(reply)))

    async def answer(line: str, writer: asyncio.StreamWriter) -> None:
        writer.write(reply[: next(cuts)])
        writer.close()

    async with scripted(answer) as engine, client_of(engine) as client:
        for _ in range(len(reply)):
            with pytest.raises(Unreachable, match="lost"):
                await client.run(command)


@pytest.mark.parametrize(("command", "reply"), [case[1:] for case in REPLIES], ids=[case[0] for case in REPLIES])
async def test_a_reply_in_slices_of_one_byte_reads_the_same(command: Command[Any], reply: bytes) -> None:
    async def outcome(client: R3Client) -> object:
        try:
            return await client.run(command)
        except Refused as error:
            return error.answer

    async def sliced(line: str, writer: asyncio.StreamWriter) -> None:
        for position in range(len(reply)):
            writer.write(reply[position : position + 1])
            await writer.drain()
            await asyncio.sleep(0)

    async with scripted(replying(reply)) as engine, client_of(engine) as client:
        whole = await outcome(client)
    async with scripted(sliced) as engine, client_of(engine) as client:
        assert await outcome(client) == whole


@given(garbage=st.binary(min_size=1, max_size=200))
@settings(max_examples=150, deadline=None)
def test_garbage_gives_a_typed_error_or_a_value_that_was_in_it(garbage: bytes) -> None:
    async def run() -> None:
        async def answer(line: str, writer: asyncio.StreamWriter) -> None:
            writer.write(garbage + b"\n")
            writer.close()

        async with scripted(answer) as engine, client_of(engine) as client:
            for command in FAILING:
                with pytest.raises((ProtocolError, Unreachable, Refused, BadPicture)):
                    await client.run(command)

    asyncio.run(run())


async def test_bytes_that_are_no_text_name_the_encoding() -> None:
    async with scripted(replying(b"ERROR: SNAPSHOT \x96 INVALID PATH\n")) as engine, client_of(engine) as client:
        with pytest.raises(ProtocolError, match=r"not utf-8 text: byte 0x96.*r3\.encoding"):
            await client.run(commands.take_snapshot("a"))


async def test_a_windows_code_page_is_understood_when_the_profile_says_so() -> None:
    async with (
        scripted(replying(b"ERROR: SNAPSHOT \x96 INVALID PATH\n")) as engine,
        client_of(engine, encoding="cp1252", line_ending="crlf") as client,
    ):
        with pytest.raises(Refused, match="INVALID PATH"):
            await client.run(commands.take_snapshot("a"))


async def test_nobody_listening_is_unreachable_and_says_what_to_do(unused_tcp_port: int) -> None:
    client = R3Client(settings_for(unused_tcp_port))
    with pytest.raises(Unreachable, match=rf"R3 at 127\.0\.0\.1:{unused_tcp_port}: .*start R3"):
        await client.run(commands.get_value(SCENE, "a"))
    await client.close()


async def test_a_black_hole_ends_within_the_bound_and_half_a_second() -> None:
    async def silent(line: str, writer: asyncio.StreamWriter) -> None:
        pass

    async with scripted(silent) as engine, client_of(engine, timeout_s=0.2) as client:
        for command in FAILING:
            start = time.monotonic()
            with pytest.raises(TimedOut):
                await client.run(command)
            assert time.monotonic() - start < 0.7


async def test_a_trickling_reply_does_not_stretch_the_bound() -> None:
    async def trickle(line: str, writer: asyncio.StreamWriter) -> None:
        while not writer.is_closing():
            writer.write(b"x")
            await asyncio.sleep(0.02)

    async with scripted(trickle) as engine, client_of(engine, timeout_s=0.2) as client:
        start = time.monotonic()
        with pytest.raises(TimedOut):
            await client.run(commands.get_value(SCENE, "a"))
        assert time.monotonic() - start < 0.7


async def test_closing_ends_a_waiting_command() -> None:
    async def silent(line: str, writer: asyncio.StreamWriter) -> None:
        asked.set()

    asked = asyncio.Event()
    async with scripted(silent) as engine:
        client = R3Client(settings_for(engine.port))
        task = asyncio.create_task(client.run(commands.get_value(SCENE, "a")))
        await asked.wait()
        await client.close()
        with pytest.raises(Unreachable):
            await task
        with pytest.raises(Unreachable, match="closed"):
            await client.run(commands.get_value(SCENE, "a"))
        await client.close()


async def test_loss_is_logged_once_and_return_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "engine_adapters.r3.client")
    dead = True

    async def answer(line: str, writer: asyncio.StreamWriter) -> None:
        if dead:
            writer.close()
        else:
            await echo_value(line, writer)

    async with scripted(answer) as engine, client_of(engine) as client:
        for _ in range(3):
            with pytest.raises(Unreachable):
                await client.run(commands.get_value(SCENE, "a"))
        dead = False
        for _ in range(3):
            await client.run(commands.get_value(SCENE, "a"))
    assert [record.levelname for record in caplog.records] == ["WARNING", "INFO"]


async def test_a_lost_reply_is_met_by_stating_the_goal_again() -> None:
    count = 0

    async def answer(line: str, writer: asyncio.StreamWriter) -> None:
        nonlocal count
        count += 1
        if count == 1:
            writer.close()
        else:
            writer.write(f"{VALUE_SET}\n".encode() * 2)

    async with scripted(answer) as engine:
        adapter = R3Engine.from_profile(StudioProfile(r3=settings_for(engine.port)))
        with pytest.raises(AdapterError):
            await adapter.show(Shown.REAL)
        count = 0
        await retry(lambda: adapter.show(Shown.REAL), classify=classify_r3, pause_s=0.0)
        await adapter.close()
    assert len(set(engine.lines)) == 1
    assert len(engine.lines) == 3


async def test_replies_in_no_order_are_met_by_one_command_per_export() -> None:
    async def answer(line: str, writer: asyncio.StreamWriter) -> None:
        writer.write(b"ERROR: NOT FOUND\n" if "lens.k2" in line else f"{VALUE_SET}\n".encode())

    async with scripted(answer) as engine:
        adapter = R3Engine.from_profile(StudioProfile(r3=settings_for(engine.port, ordered_replies=False)))
        with pytest.raises(Refused, match=r'"lens\.k2" SetValue "0\.0": ERROR: NOT FOUND'):
            await adapter.apply(LensValues(60.0))
        await adapter.close()
    assert [line.count("SetValue") for line in engine.lines] == [1] * 5


async def test_a_state_that_could_not_be_put_back_is_told_before_anything_is_changed() -> None:
    async def answer(line: str, writer: asyncio.StreamWriter) -> None:
        writer.write(value_reply('1" "other" SetValue "2' if "lens.k1" in line else "1"))

    async with scripted(answer) as engine:
        adapter = R3Engine.from_profile(StudioProfile(r3=settings_for(engine.port)))
        with pytest.raises(ProtocolError, match="could not be put back"):
            await adapter.read_state()
        await adapter.close()
    assert not any("SetValue" in line for line in engine.lines)


async def test_two_snapshots_at_once_are_taken_and_got_in_turn() -> None:
    async def answer(line: str, writer: asyncio.StreamWriter) -> None:
        writer.write(b"OK: SNAPSHOT TAKEN\n" if "take" in line else PICTURE)

    async with scripted(answer) as engine:
        source = R3Snapshots(R3Client(settings_for(engine.port)), "a")
        await asyncio.gather(source.fetch(), source.fetch())
        await source.close()
    assert [line.split(" ")[0] for line in engine.lines] == ["engine.takeSnapshot", "engine.getSnapshot"] * 2


async def test_rename_goes_out_as_the_seed_writes_it() -> None:
    async with scripted(replying(b"OK: SCENE EXPORT RENAME - Renamed.\n")) as engine, client_of(engine) as client:
        assert await client.run(commands.rename(SCENE, "a", "b")) == "OK: SCENE EXPORT RENAME - Renamed."
    assert engine.lines == [f'scene "{SCENE}" export "a" rename "b"']
