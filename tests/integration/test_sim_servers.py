"""The simulated studio on its real sockets, and as a process of its own."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.image import decode_picture
from calibration.types import Picture
from engine_adapters.sim.__main__ import parse_options
from engine_adapters.sim.errors import SimulatorError
from engine_adapters.sim.mockboard_server import IMAGE_PATH
from engine_adapters.sim.process import SimulatorOptions, main, serve, simulated_studio

SCENE = 'scene "Lensmatch/Calibration" export'
VALUE_SET = "OK: SCENE EXPORT SETVALUE - Value Set."
BOUND_S = 10.0


@pytest.fixture
def lens_file(tmp_path: Path) -> Path:
    """A small picture keeps the tests quick."""
    path = tmp_path / "lens.json"
    levels = [{"zoom": 0.0, "focus": 0.5, "fov_x_deg": 60.0}, {"zoom": 1.0, "focus": 0.5, "fov_x_deg": 20.0}]
    truth = {"lens_truth": 1, "lens": "T", "image_size": [320, 180], "sensor_mm": [9.6, 5.4], "levels": levels}
    path.write_text(json.dumps(truth), encoding="utf-8")
    return path


@contextlib.asynccontextmanager
async def running(lens_file: Path, *faults: str, **changes: Any) -> AsyncIterator[dict[str, Any]]:
    quick: dict[str, Any] = {"picture_time_ms": 5.0, "head_speed_deg_s": 5000.0, "snapshot_time_s": 0.01}
    ports = {"r3_port": 0, "mockboard_port": 0, "head_port": 0}
    options = SimulatorOptions(lens_file=lens_file, faults=faults, **(ports | quick | changes))
    async with simulated_studio(options) as addresses:
        yield addresses


class Line:
    """A raw R3 client."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    async def ask(self, command: str | bytes, replies: int = 1, ending: bytes = b"\n") -> list[str]:
        self.writer.write((command.encode() if isinstance(command, str) else command) + ending)
        return [await self.reply() for _ in range(replies)]

    async def reply(self) -> str:
        line = await asyncio.wait_for(self.reader.readline(), BOUND_S)
        return line.decode().removesuffix("\n")


@contextlib.asynccontextmanager
async def r3(addresses: dict[str, Any]) -> AsyncIterator[Line]:
    reader, writer = await asyncio.open_connection(addresses["r3"]["host"], addresses["r3"]["port"], limit=1 << 24)
    try:
        yield Line(reader, writer)
    finally:
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()


async def http(url: str, path: str, method: str = "GET", body: bytes = b"") -> tuple[int, bytes]:
    """One HTTP exchange, written out so that a spoilt answer is seen as it is."""
    host, _, port = url.removeprefix("http://").partition(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    try:
        head = f"{method} {path} HTTP/1.1\r\nHost: {host}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
        writer.write(head.encode() + body)
        answer = await asyncio.wait_for(reader.read(), BOUND_S)
    finally:
        writer.close()
        await writer.wait_closed()
    top, _, content = answer.partition(b"\r\n\r\n")
    return int(top.split(b" ")[1]) if top else 0, content


async def fetch(addresses: dict[str, Any]) -> Picture:
    status, body = await http(addresses["mockboard"]["url"], IMAGE_PATH)
    assert status == 200
    return decode_picture(base64.b64decode(body, validate=True), expected_size=(320, 180))


async def post(addresses: dict[str, Any], content: object) -> tuple[int, Any]:
    body = content if isinstance(content, bytes) else json.dumps(content).encode()
    status, answer = await http(addresses["head"]["url"], "/head", "POST", body)
    return status, json.loads(answer)


def files_in(folder: str) -> list[str] | None:
    """The names in a folder, sorted; None where there is no such folder."""
    path = Path(folder)
    return sorted(entry.name for entry in path.iterdir()) if path.is_dir() else None


@pytest.mark.parametrize("ending", [b"\n", b"\r\n"])
async def test_every_r3_command_is_answered_as_the_study_writes_it(lens_file: Path, ending: bytes) -> None:
    async with running(lens_file) as addresses, r3(addresses) as line:
        assert await line.ask(f'{SCENE} "lens.k1" SetValue "-0.125"', ending=ending) == [VALUE_SET]
        assert await line.ask(f'{SCENE} "lens.k1" getValue', ending=ending) == ["OK: SCENE EXPORT GETVALUE - -0.125"]
        multi = f'{SCENE} "lens.k1" SetValue "0.5" "lens.k2" SetValue "1e-3" "lens.fov_x" SetValue "61.5"'
        assert await line.ask(multi, replies=3, ending=ending) == [VALUE_SET] * 3
        assert await line.ask(f'{SCENE} "lens.k2" getValue', ending=ending) == ["OK: SCENE EXPORT GETVALUE - 1e-3"]
        (packet,) = await line.ask('engine.tracking "Cam0" get', ending=ending)
        head, _, rest = packet.partition("{")
        assert head == "OK: CURRENT CAMERA PARAMETERS: "
        values = json.loads("{" + rest)
        assert values["FovX"] == 61.5
        assert (values["PosX"], values["PosY"], values["PosZ"]) == (0.0, 0.0, 1.6)
        assert (values["SensorWidth"], values["SensorHeight"]) == (9.6, 5.4)
        assert len(values["ViewMatrix"]) == 16
        assert await line.ask(f'{SCENE} "lens.k2" rename "zwei ü"', ending=ending) == [
            "OK: SCENE EXPORT RENAME - Renamed."
        ]
        assert await line.ask(f'{SCENE} "zwei ü" getValue', ending=ending) == ["OK: SCENE EXPORT GETVALUE - 1e-3"]


async def test_snapshots_go_to_disk_and_come_back(lens_file: Path) -> None:
    async with running(lens_file) as addresses, r3(addresses) as line:
        unreadable = "ERROR: GETSNAPSHOT - COULD NOT READ LAST SNAPSHOT FILE"
        assert await line.ask('engine.getSnapshot "a"') == [unreadable]
        assert await line.ask('engine.takeSnapshot "a"') == ["OK: SNAPSHOT TAKEN"]
        (reply,) = await line.ask('engine.getSnapshot "a"')
        before, data, after = reply.removeprefix("OK: ").split(" ")
        assert before == after == "<IMAGE>"
        assert decode_picture(base64.b64decode(data, validate=True)).shape == (180, 320, 3)
        inside = Path(addresses["projects"]) / "b"
        assert await line.ask(f'engine.takeSnapshot "{inside}"') == ["OK: SNAPSHOT TAKEN"]
        assert files_in(addresses["projects"]) == ["a.png", "b.png"]
    assert files_in(addresses["projects"]) is None


@pytest.mark.parametrize(
    "name",
    ["../a", "/etc/a", "sub/a", "C:/a", "C:a", "\\\\host\\share\\a", "//host/share/a", "a:b", "", "..", "CON", "a\x07"],
)
async def test_snapshots_outside_the_projects_folder_are_refused(lens_file: Path, name: str) -> None:
    async with running(lens_file) as addresses, r3(addresses) as line:
        assert await line.ask(f'engine.takeSnapshot "{name}"') == ["ERROR: SNAPSHOT \N{EN DASH} INVALID PATH"]
        assert await line.ask(f'engine.getSnapshot "{name}"') == ["ERROR: GETSNAPSHOT - INVALID PATH"]
        inside = f"{addresses['projects']}/../a"
        assert await line.ask(f'engine.takeSnapshot "{inside}"') == ["ERROR: SNAPSHOT \N{EN DASH} INVALID PATH"]
        assert files_in(addresses["projects"]) == []


@pytest.mark.parametrize(
    "command",
    [
        b"nonsense",
        b'"engine.takeSnapshot" "a"',
        b"engine.takeSnapshot a",
        b'engine.takeSnapshot "a',
        b'engine.tracking "Cam9" get',
        b'engine.tracking "Cam0"',
        b'scene "Lensmatch/Calibration" export',
        b'scene "other/scene" export "lens.k1" getValue',
        b'scene "Lensmatch/Calibration" export "none" getValue',
        b'scene "Lensmatch/Calibration" export "lens.k1" SetValue "x"',
        b'scene "Lensmatch/Calibration" export "lens.k1" SetValue "1" "lens.k2" Set "2"',
        b'scene "Lensmatch/Calibration" export "lens.k1" rename "lens.k2"',
        b"\xff\xfe",
    ],
)
async def test_wrong_commands_get_one_error_line_and_the_line_lives_on(lens_file: Path, command: bytes) -> None:
    async with running(lens_file) as addresses, r3(addresses) as line:
        (reply,) = await line.ask(command)
        assert reply.startswith("ERROR: ")
        assert await line.ask(f'{SCENE} "lens.k1" getValue') == ["OK: SCENE EXPORT GETVALUE - 0"]


async def test_one_wrong_export_of_several_is_told_in_its_place(lens_file: Path) -> None:
    async with running(lens_file) as addresses, r3(addresses) as line:
        replies = await line.ask(f'{SCENE} "lens.k1" SetValue "1" "none" SetValue "1" "lens.k2" SetValue "1"', 3)
        assert replies == [VALUE_SET, "ERROR: SCENE EXPORT SETVALUE - EXPORT NOT FOUND", VALUE_SET]


async def test_an_endless_command_is_cut_off(lens_file: Path) -> None:
    async with running(lens_file) as addresses, r3(addresses) as line:
        assert await line.ask(b"x" * 200_000) == ["ERROR: COMMAND TOO LONG"]
        # The rest that nobody reads may reset the connection: it ends, one way or the other.
        with contextlib.suppress(ConnectionError):
            assert await asyncio.wait_for(line.reader.read(), BOUND_S) == b""


async def test_pictures_show_the_layers_after_the_delay(lens_file: Path) -> None:
    delay, picture_time_s = 8, 0.03
    async with (
        running(lens_file, delay_frames=delay, picture_time_ms=picture_time_s * 1e3) as addresses,
        r3(addresses) as line,
    ):
        assert (await fetch(addresses))[:20].any()
        early = 0
        for _ in range(10):  # on a busy machine the first picture may come too late to be an early one
            await line.ask(f'{SCENE} "background.visible" SetValue "1"')
            await asyncio.sleep((delay + 1) * picture_time_s)
            early += await early_pictures(addresses, line, delay * picture_time_s, picture_time_s)
            if early:
                break
        assert early > 0
        await line.ask(f'{SCENE} "object.visible" SetValue "0"')
        await asyncio.sleep((delay + 1) * picture_time_s)
        assert not (await fetch(addresses)).any()


async def early_pictures(addresses: dict[str, Any], line: Line, delay_s: float, picture_time_s: float) -> int:
    """Switch the background off and check two pictures from after the delay; returns how many came before it."""
    sent_s = time.monotonic()
    await line.ask(f'{SCENE} "background.visible" SetValue "0"')
    acknowledged_s = time.monotonic()
    early = late = 0
    while late < 2:
        asked_s = time.monotonic()
        picture = await fetch(addresses)
        assert picture.any()
        on_black = not picture[:20].any()
        if time.monotonic() < sent_s + delay_s - picture_time_s:
            early += 1
            assert not on_black
        if asked_s > acknowledged_s + delay_s:
            late += 1
            assert on_black
    return early


async def test_a_picture_takes_its_time_and_is_counted(lens_file: Path) -> None:
    async with running(lens_file, picture_time_ms=40.0) as addresses, r3(addresses) as line:
        await fetch(addresses)
        started = time.monotonic()
        for _ in range(3):
            await fetch(addresses)
        assert time.monotonic() - started >= 3 * 0.040
        await line.ask(f'{SCENE} "lens.k1" SetValue "0.1"')
        await post(addresses, {"pan_deg": 5.0})
        status, body = await http(addresses["head"]["url"], "/stats")
        stats = json.loads(body)
        assert status == 200
        assert (stats["pictures"], stats["changes"], stats["movements"]) == (4, 1, 1)
        assert stats["movements_s"] == pytest.approx(0.051)
        assert stats["render_ms_mean"] > 0


async def test_the_head_moves_and_the_picture_moves_with_it(lens_file: Path) -> None:
    async with running(lens_file, delay_frames=1) as addresses:
        before = await fetch(addresses)
        status, state = await post(addresses, {"pan_deg": -10.0, "tilt_deg": 3.0, "roll_deg": 0.0, "zoom": 1.0})
        assert status == 200
        assert state == {"pan_deg": -10.0, "tilt_deg": 3.0, "roll_deg": 0.0, "zoom": 1.0, "focus": 0.5}
        await fetch(addresses)
        await fetch(addresses)
        after = await fetch(addresses)
        assert np.abs(after.astype(int) - before).mean() > 5
        assert json.loads((await http(addresses["head"]["url"], "/head"))[1]) == state


@pytest.mark.parametrize(
    ("body", "status"),
    [
        (b"{", 400),
        (b"[]", 422),
        (b"{}", 422),
        (b'{"pan_deg": NaN}', 422),
        (b'{"pan_deg": 1e999}', 422),
        (b'{"pan_deg": 171}', 422),
        (b'{"pan_deg": "1"}', 422),
        (b'{"pan_deg": true}', 422),
        (b'{"yaw": 1}', 422),
        (b'{"zoom": 1.01}', 422),
        (b"9" * 100_000, 413),
    ],
)
async def test_wrong_goals_are_refused_with_their_reason(lens_file: Path, body: bytes, status: int) -> None:
    async with running(lens_file) as addresses:
        got, answer = await post(addresses, body)
        assert got == status
        assert set(answer) == {"error"}


async def test_other_addresses_and_methods_are_refused(lens_file: Path) -> None:
    async with running(lens_file) as addresses:
        assert (await http(addresses["mockboard"]["url"], "/"))[0] == 404
        assert (await http(addresses["mockboard"]["url"], IMAGE_PATH, "POST"))[0] == 405
        assert (await http(addresses["head"]["url"], "/other"))[0] == 404
        assert (await http(addresses["head"]["url"], "/head", "DELETE"))[0] == 405


async def test_many_requests_share_one_connection(lens_file: Path) -> None:
    async with running(lens_file) as addresses:
        host, _, port = addresses["mockboard"]["url"].removeprefix("http://").partition(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        for _ in range(3):
            writer.write(f"GET {IMAGE_PATH} HTTP/1.1\r\nHost: x\r\nAccept: */*\r\n\r\n".encode())
            head = (await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), BOUND_S)).decode()
            assert head.startswith("HTTP/1.1 200 OK\r\n")
            assert "Connection: keep-alive" in head
            length = int(head.split("Content-Length: ")[1].split("\r\n")[0])
            base64.b64decode(await asyncio.wait_for(reader.readexactly(length), BOUND_S), validate=True)
        writer.close()
        await writer.wait_closed()


async def test_r3_faults_strike_the_exchanges_they_name(lens_file: Path) -> None:
    faults = ("r3:late=0.2@2", "r3:split@3", "r3:garbage@4", "r3:drop@5", "r3:disconnect@6")
    async with running(lens_file, *faults) as addresses, r3(addresses) as line:
        get = f'{SCENE} "lens.fov_x" getValue'
        good = "OK: SCENE EXPORT GETVALUE - 50"
        assert await line.ask(get) == [good]
        started = time.monotonic()
        assert await line.ask(get) == [good]
        assert time.monotonic() - started >= 0.2
        line.writer.write(get.encode() + b"\n")
        first = await asyncio.wait_for(line.reader.read(4096), BOUND_S)
        assert len(first) < len(good)
        assert first + (await asyncio.wait_for(line.reader.readline(), BOUND_S)) == good.encode() + b"\n"
        line.writer.write(get.encode() + b"\n")
        assert b"nonsense" in await asyncio.wait_for(line.reader.readline(), BOUND_S)
        line.writer.write(get.encode() + b"\n")
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(line.reader.readline(), 0.1)
        line.writer.write(get.encode() + b"\n")
        assert await asyncio.wait_for(line.reader.read(), BOUND_S) == (good + "\n").encode()[: (len(good) + 1) // 2]
        async with r3(addresses) as another:
            assert await another.ask(get) == [good]


async def test_mockboard_faults_strike_the_exchanges_they_name(lens_file: Path) -> None:
    faults = ("mockboard:status=503@2", "mockboard:stale@3", "mockboard:garbage@4", "mockboard:disconnect@5")
    async with running(lens_file, *faults, "mockboard:late=0.2@6", "mockboard:split@7") as addresses:
        url = addresses["mockboard"]["url"]
        _, first = await http(url, IMAGE_PATH)
        assert (await http(url, IMAGE_PATH))[0] == 503
        assert (await http(url, IMAGE_PATH)) == (200, first)
        status, nonsense = await http(url, IMAGE_PATH)
        assert status == 200
        assert b"not a picture" in nonsense
        assert 0 < len((await http(url, IMAGE_PATH))[1]) < len(first)
        started = time.monotonic()
        assert (await http(url, IMAGE_PATH))[0] == 200
        assert time.monotonic() - started >= 0.2
        _, pieces = await http(url, IMAGE_PATH)
        assert len(pieces) == len(first)
        assert pieces != first


async def test_a_dropped_picture_never_comes(lens_file: Path) -> None:
    async with running(lens_file, "mockboard:drop@1") as addresses:
        host, _, port = addresses["mockboard"]["url"].removeprefix("http://").partition(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(f"GET {IMAGE_PATH} HTTP/1.1\r\n\r\n".encode())
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(reader.read(1), 0.2)
        writer.close()
        await writer.wait_closed()


async def test_serve_ends_when_told_to_with_clients_still_there(lens_file: Path) -> None:
    stop = asyncio.Event()
    addresses: asyncio.Future[dict[str, Any]] = asyncio.get_running_loop().create_future()
    options = SimulatorOptions(lens_file=lens_file, r3_port=0, mockboard_port=0, head_port=0)
    task = asyncio.create_task(serve(options, ready=addresses.set_result, stop=stop))
    async with r3(await asyncio.wait_for(addresses, BOUND_S)) as line:
        stop.set()
        await asyncio.wait_for(task, BOUND_S)
        assert await asyncio.wait_for(line.reader.read(), BOUND_S) == b""


async def test_a_port_already_taken_is_told_and_nothing_keeps_listening(lens_file: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(SimulatorError, match=f"MockBoard, 127.0.0.1:{port}: cannot listen"):
            async with running(lens_file, mockboard_port=port):
                pass


def start(*arguments: str, stdin: int | None = None) -> subprocess.Popen[str]:
    free = ["--r3-port", "0", "--mockboard-port", "0", "--head-port", "0"]
    return subprocess.Popen(
        [sys.executable, "-m", "engine_adapters.sim", *free, *arguments],
        stdin=stdin or subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        encoding="utf-8",
    )


def ready_line(process: subprocess.Popen[str]) -> dict[str, Any]:
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line, process.communicate()[1]
    content = json.loads(line)
    assert isinstance(content, dict)
    return content


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGTERM that a process could catch")
def test_the_process_prints_one_line_and_ends_on_a_signal(lens_file: Path) -> None:
    process = start("--lens-file", str(lens_file))
    try:
        ready = ready_line(process)
        assert ready["pid"] == process.pid
        assert (ready["lens"], ready["room"]) == ("T", "boards")
        with socket.create_connection((ready["r3"]["host"], ready["r3"]["port"]), timeout=BOUND_S) as connection:
            connection.sendall(b'engine.tracking "Cam0" get\n')
            assert connection.recv(200).startswith(b"OK: CURRENT CAMERA PARAMETERS: {")
        process.terminate()
        rest, errors = process.communicate(timeout=BOUND_S)
        assert (process.returncode, rest, errors) == (0, "", "")
    finally:
        process.kill()
        process.communicate()


def test_the_process_ends_with_its_parent(lens_file: Path) -> None:
    process = start("--lens-file", str(lens_file), "--exit-with-parent", stdin=subprocess.PIPE)
    try:
        ready_line(process)
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(timeout=BOUND_S) == 0
    finally:
        process.kill()
        process.stdin = None
        process.communicate()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--lens-file", "none.json"], "none.json: no such lens file"),
        (["--lens", "none"], "no embedded lens is called 'none'"),
        (["--fault", "r3:explode@1"], "no fault is called explode"),
        (["--r3-port", "70000"], "70000 is no port"),
        (["--delay-frames", "-1"], "delay of -1 frames"),
        (["--picture-time-ms", "nan"], "picture time of nan ms"),
    ],
)
def test_what_it_cannot_run_with_is_told_in_one_line(
    arguments: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(parse_options(arguments)) == 1
    out, errors = capsys.readouterr()
    assert out == ""
    assert told in errors
    assert len(errors.splitlines()) == 1


@pytest.mark.parametrize("arguments", [["--room", "garden"], ["--payload", "x"], ["--seed", "-1"], ["--r3-port", "x"]])
def test_a_wrong_command_line_is_wrong_usage(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        parse_options(arguments)
    assert caught.value.code == 2
    assert arguments[0] in capsys.readouterr().err
