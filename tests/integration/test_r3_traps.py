"""The traps of the R3 socket, each with a scripted server on a real socket and a test named after it."""

from __future__ import annotations

import asyncio
import base64
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine_adapters.errors import (
    ProtocolError,
    Refused,
    TimedOut,
    UnsafeText,
)
from engine_adapters.ports import LensValues
from engine_adapters.profile import StudioProfile
from engine_adapters.r3 import commands
from engine_adapters.r3.client import R3Client, R3Engine, R3Snapshots
from tests.support.scripted_r3 import (
    SCENE,
    VALUE_SET,
    client_of,
    dropped,
    echo_value,
    replying,
    scripted,
    settings_for,
    value_reply,
)

# --- trap 1: after a time-out the next command received the previous reply --------------------------------------


async def test_trap_1_late_reply_after_timeout_is_not_the_next_commands() -> None:
    late = asyncio.Event()

    async def answer(line: str, writer: asyncio.StreamWriter) -> None:
        if '"slow"' in line:
            await late.wait()
        await echo_value(line, writer)

    async with scripted(answer) as engine, client_of(engine, timeout_s=0.3) as client:
        with pytest.raises(TimedOut) as caught:
            await client.run(commands.get_value(SCENE, "slow"))
        assert caught.value.bound_s == 0.3
        late.set()
        assert await client.run(commands.get_value(SCENE, "next")) == "next"
        assert engine.connections == 2


async def test_trap_1_cancellation_in_mid_exchange_closes_the_connection() -> None:
    asked, late = asyncio.Event(), asyncio.Event()

    async def answer(line: str, writer: asyncio.StreamWriter) -> None:
        if '"slow"' in line:
            asked.set()
            await late.wait()
        await echo_value(line, writer)

    async with scripted(answer) as engine, client_of(engine) as client:
        task = asyncio.create_task(client.run(commands.get_value(SCENE, "slow")))
        await asked.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        late.set()
        assert await client.run(commands.get_value(SCENE, "next")) == "next"
        assert engine.connections == 2


async def test_trap_1_cancellation_while_waiting_for_the_turn_leaves_the_connection() -> None:
    asked, late = asyncio.Event(), asyncio.Event()

    async def answer(line: str, writer: asyncio.StreamWriter) -> None:
        asked.set()
        await late.wait()
        await echo_value(line, writer)

    async with scripted(answer) as engine, client_of(engine) as client:
        first = asyncio.create_task(client.run(commands.get_value(SCENE, "first")))
        await asked.wait()
        second = asyncio.create_task(client.run(commands.get_value(SCENE, "second")))
        await asyncio.sleep(0)
        second.cancel()
        late.set()
        assert await first == "first"
        assert await client.run(commands.get_value(SCENE, "third")) == "third"
        assert engine.connections == 1
        assert not any("second" in line for line in engine.lines)


async def test_trap_1_concurrent_commands_get_their_own_replies() -> None:
    async with scripted(echo_value) as engine, client_of(engine) as client:
        names = [f"export_{number}" for number in range(50)]
        answers = await asyncio.gather(*(client.run(commands.get_value(SCENE, name)) for name in names))
        assert answers == names
        assert engine.connections == 1


async def test_trap_1_bytes_between_exchanges_are_told_and_the_connection_is_dropped() -> None:
    surplus = asyncio.Event()

    async def answer(line: str, writer: asyncio.StreamWriter) -> None:
        await echo_value(line, writer)
        if '"first"' in line:
            await writer.drain()
            await surplus.wait()
            writer.write(value_reply("stray"))
            await writer.drain()
            stray_sent.set()

    stray_sent = asyncio.Event()
    async with scripted(answer) as engine, client_of(engine) as client:
        assert await client.run(commands.get_value(SCENE, "first")) == "first"
        surplus.set()
        await stray_sent.wait()
        await dropped(client)
        with pytest.raises(ProtocolError, match="no command asked for"):
            await client.run(commands.get_value(SCENE, "second"))
        assert await client.run(commands.get_value(SCENE, "third")) == "third"
        assert [line.split('"')[3] for line in engine.lines] == ["first", "third"]


@pytest.mark.parametrize("extra", ["OK: SCENE EXPORT GETVALUE - 1\n", "x", "\n"])
async def test_trap_1_more_than_the_reply_is_refused(extra: str) -> None:
    async with scripted(replying(value_reply("0.5") + extra.encode())) as engine, client_of(engine) as client:
        with pytest.raises(ProtocolError, match="more than the answer"):
            await client.run(commands.get_value(SCENE, "a"))


@pytest.mark.parametrize(
    "reply", [VALUE_SET, "OK: SNAPSHOT TAKEN", "OK: CURRENT CAMERA PARAMETERS:", "OK: <IMAGE> AAAA <IMAGE>"]
)
async def test_trap_1_another_commands_reply_never_passes_for_a_value(reply: str) -> None:
    async with scripted(replying(reply.encode() + b"\n", value_reply("2"))) as engine, client_of(engine) as client:
        with pytest.raises(ProtocolError, match="is not an answer to"):
            await client.run(commands.get_value(SCENE, "a"))
        assert await client.run(commands.get_value(SCENE, "a")) == "2"
        assert engine.connections == 2


async def test_a_connection_that_the_engine_ended_between_commands_is_renewed() -> None:
    async with scripted(echo_value) as engine, client_of(engine) as client:
        assert await client.run(commands.get_value(SCENE, "a")) == "a"
        engine.drop_all()
        await dropped(client)
        assert await client.run(commands.get_value(SCENE, "b")) == "b"
        assert engine.connections == 2


async def test_a_refusal_leaves_the_connection_open() -> None:
    replies = replying(b"ERROR: NO SUCH EXPORT\n", value_reply("2"))
    async with scripted(replies) as engine, client_of(engine) as client:
        with pytest.raises(Refused) as caught:
            await client.run(commands.get_value(SCENE, "a"))
        assert caught.value.answer == "ERROR: NO SUCH EXPORT"
        assert await client.run(commands.get_value(SCENE, "b")) == "2"
        assert engine.connections == 1


# --- trap 3: the reply count belongs to the command, the bound too ----------------------------------------------


async def test_trap_3_multi_export_waits_for_one_reply_per_export() -> None:
    held = asyncio.Event()

    async def answer(line: str, writer: asyncio.StreamWriter) -> None:
        if "getValue" in line:
            await echo_value(line, writer)
            return
        for number in range(line.count("SetValue")):
            if number == 2:
                await held.wait()
            writer.write(f"{VALUE_SET}\n".encode())
            await writer.drain()

    async with scripted(answer) as engine, client_of(engine) as client:
        values = [(f"e{number}", "1") for number in range(6)]
        task = asyncio.create_task(client.run(commands.multi_export(SCENE, values)))
        await asyncio.sleep(0.1)
        assert not task.done()
        held.set()
        await task
        assert await client.run(commands.get_value(SCENE, "after")) == "after"


async def test_trap_3_an_error_in_the_middle_of_a_multi_export_is_named_and_keeps_step() -> None:
    lines = [VALUE_SET, "ERROR: SCENE EXPORT – NOT FOUND", VALUE_SET]
    replies = replying("".join(f"{line}\r\n" for line in lines).encode(), value_reply("2"))
    async with scripted(replies) as engine, client_of(engine) as client:
        with pytest.raises(Refused, match=r"1 of 3: b.*NOT FOUND"):
            await client.run(commands.multi_export(SCENE, [("a", "1"), ("b", "2"), ("c", "3")]))
        assert await client.run(commands.get_value(SCENE, "a")) == "2"
        assert engine.connections == 1


async def test_trap_3_one_error_for_a_whole_multi_export_is_told_and_closes() -> None:
    replies = replying(b"ERROR: SCENE NOT FOUND\n", value_reply("2"))
    async with scripted(replies) as engine, client_of(engine, timeout_s=0.3) as client:
        with pytest.raises(Refused, match="SCENE NOT FOUND"):
            await client.run(commands.multi_export(SCENE, [("a", "1"), ("b", "2")]))
        assert await client.run(commands.get_value(SCENE, "a")) == "2"
        assert engine.connections == 2


async def test_trap_3_a_picture_of_megabytes_comes_whole() -> None:
    picture = b"\x89PNG\r\n\x1a\n" + bytes(6_000_000) + b"\x00\x00\x00\x00IEND\xaeB`\x82"
    reply = b"OK: <IMAGE> " + base64.b64encode(picture) + b" <IMAGE>\n"
    async with scripted(replying(b"OK: SNAPSHOT TAKEN\n", reply)) as engine:
        source = R3Snapshots(R3Client(settings_for(engine.port)), "lensmatch")
        frame = await source.fetch()
        await source.close()
    assert frame.data == picture
    assert frame.requested_at_s < frame.received_at_s
    assert engine.lines == ['engine.takeSnapshot "lensmatch"', 'engine.getSnapshot "lensmatch"']


async def test_trap_3_the_bound_is_the_commands_own() -> None:
    answer = replying(b"OK: " + b"x" * 200_000 + b"\n")
    async with scripted(answer) as engine, client_of(engine, max_reply_mib=0.1) as client:
        with pytest.raises(ProtocolError, match="larger than its limit"):
            await client.run(commands.get_value(SCENE, "a"))


async def test_trap_3_an_endless_reply_ends_at_the_bound() -> None:
    async def flood(line: str, writer: asyncio.StreamWriter) -> None:
        while True:
            writer.write(b"x" * 65536)
            await writer.drain()

    async with scripted(flood) as engine, client_of(engine) as client:
        with pytest.raises(ProtocolError, match="larger than its limit"):
            await client.run(commands.get_tracking("Cam0"))


# --- trap 4: quotes, line breaks and control characters would inject a second command ----------------------------


@given(name=st.text(max_size=30), value=st.text(max_size=30))
@settings(max_examples=400, deadline=None)
def test_trap_4_a_name_is_refused_or_arrives_as_one_command_with_equal_arguments(name: str, value: str) -> None:
    try:
        command = commands.set_value(SCENE, name, value)
    except UnsafeText:
        return
    data = command.encode()
    assert data.count(b"\n") == 1
    assert data.endswith(b"\n")
    assert data.decode().rstrip("\n").split('"') == ["scene ", SCENE, " export ", name, " SetValue ", value, ""]
    assert not any(ord(character) < 32 or ord(character) == 127 for character in name + value)


@given(
    position=st.integers(0, 6),
    hostile=st.sampled_from(
        ['"', "\r", "\n", "\x00", "\x1b", "\x7f", "\x85", "\u2028", "\u2029", "\u202e", "\\", "\uff02"]
    ),
    which=st.integers(0, 9),
)
@settings(max_examples=200, deadline=None)
def test_trap_4_a_hostile_character_is_refused_wherever_it_stands(position: int, hostile: str, which: int) -> None:
    text = "abcdef"[:position] + hostile + "abcdef"[position:]
    builders: list[Callable[[], object]] = [
        lambda: commands.take_snapshot(text),
        lambda: commands.get_snapshot(text),
        lambda: commands.get_tracking(text),
        lambda: commands.set_value(text, "e", "1"),
        lambda: commands.set_value(SCENE, text, "1"),
        lambda: commands.set_value(SCENE, "e", text),
        lambda: commands.get_value(SCENE, text),
        lambda: commands.rename(SCENE, "e", text),
        lambda: commands.multi_export(SCENE, [("e", "1"), (text, "1")]),
        lambda: commands.multi_export(SCENE, [("e", "1"), ("f", text)]),
    ]
    with pytest.raises(UnsafeText):
        builders[which]()


@given(st.floats(allow_nan=True, allow_infinity=True))
@settings(max_examples=300, deadline=None)
def test_trap_4_a_number_is_refused_or_reads_back_to_the_same(number: float) -> None:
    try:
        text = commands.number_text("n", number)
    except UnsafeText:
        assert number != number or abs(number) == float("inf")
        return
    assert float(text) == number
    assert set(text) <= set("-.0123456789")


async def test_trap_4_nothing_is_sent_of_an_unsafe_lens() -> None:
    async with scripted(echo_value) as engine:
        adapter = R3Engine.from_profile(StudioProfile(r3=settings_for(engine.port)))
        for values in (LensValues(float("nan")), LensValues(60.0, k1=float("inf")), LensValues(180.0)):
            with pytest.raises(UnsafeText):
                await adapter.apply(values)
        await adapter.close()
        assert engine.lines == []
