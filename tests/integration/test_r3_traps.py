"""The traps of the R3 socket, each with a scripted server on a real socket and a test named after it."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import time
from collections.abc import AsyncIterator, Awaitable, Callable
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
    UnsafeText,
)
from engine_adapters.ports import LensValues, Shown
from engine_adapters.profile import R3Settings, StudioProfile
from engine_adapters.r3 import commands
from engine_adapters.r3.client import R3Client, R3Engine, R3Snapshots
from engine_adapters.r3.protocol import Command
from engine_adapters.retry import classify_r3, retry

VALUE_SET = "OK: SCENE EXPORT SETVALUE - Value Set."
SCENE = "Lensmatch/Calibration"
PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 40 + b"\x00\x00\x00\x00IEND\xaeB`\x82"

Answer = Callable[[str, asyncio.StreamWriter], Awaitable[None]]


class ScriptedEngine:
    """A text server on loopback whose every answer is a test's own."""

    def __init__(self, answer: Answer) -> None:
        self.lines: list[str] = []
        self.connections = 0
        self.port = 0
        self._answer = answer
        self._writers: set[asyncio.StreamWriter] = set()
        self._handlers: set[asyncio.Task[None]] = set()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        self._writers.add(writer)
        if (handler := asyncio.current_task()) is not None:
            self._handlers.add(handler)
        # Only this server's end cancels a handler, and waits for it.
        with contextlib.suppress(ConnectionError, asyncio.CancelledError):
            while line := await reader.readline():
                self.lines.append(line.decode().rstrip("\r\n"))
                await self._answer(self.lines[-1], writer)
        writer.close()

    def drop_all(self) -> None:
        for writer in self._writers:
            writer.close()

    async def end(self) -> None:
        self.drop_all()
        for handler in self._handlers:
            handler.cancel()
        await asyncio.gather(*self._handlers, return_exceptions=True)


@contextlib.asynccontextmanager
async def scripted(answer: Answer) -> AsyncIterator[ScriptedEngine]:
    engine = ScriptedEngine(answer)
    server = await asyncio.start_server(engine.serve, "127.0.0.1", 0)
    engine.port = server.sockets[0].getsockname()[1]
    try:
        yield engine
    finally:
        server.close()
        await engine.end()
        await server.wait_closed()


def settings_for(port: int, *, timeout_s: float = 5.0, **changes: Any) -> R3Settings:
    return R3Settings(
        port=port,
        connect_timeout_s=timeout_s,
        command_timeout_s=timeout_s,
        snapshot_timeout_s=timeout_s,
        picture_timeout_s=timeout_s,
        **changes,
    )


@contextlib.asynccontextmanager
async def client_of(engine: ScriptedEngine, **changes: Any) -> AsyncIterator[R3Client]:
    client = R3Client(settings_for(engine.port, **changes))
    try:
        yield client
    finally:
        await client.close()


async def dropped(client: R3Client) -> None:
    """Returns when the client has seen what happened to its connection between two commands."""
    async with asyncio.timeout(5.0):
        while client.connected:  # noqa: ASYNC110  (the client has no event to wait for)
            await asyncio.sleep(0.001)


def replying(*replies: bytes) -> Answer:
    """Answers with one reply after the other, whatever is asked."""
    left = list(replies)

    async def answer(line: str, writer: asyncio.StreamWriter) -> None:
        writer.write(left.pop(0))

    return answer


def value_reply(value: str) -> bytes:
    return f"OK: SCENE EXPORT GETVALUE - {value}\n".encode()


async def echo_value(line: str, writer: asyncio.StreamWriter) -> None:
    """Answers getValue with the export's own name, so that a shifted reply shows."""
    writer.write(value_reply(line.split('"')[3]))


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


# --- the wire at its worst ---------------------------------------------------------------------------------------

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
