"""Record and replay: what comes back, and what is told when a run goes another way."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from engine_adapters.errors import AdapterError, BadPicture, ProtocolError, Refused, TimedOut, Unreachable, UnsafeText
from engine_adapters.ports import EncodedFrame, HeadState
from engine_adapters.transcript import TRANSCRIPT_NAME, Recorder, Replay, ReplayMismatch

PNG = b"\x89PNG\r\n\x1a\n" + bytes(50)
STATE = HeadState(0.1 + 0.2, 1e-17, 0.0, 0.5, 1 / 3)


class Head:
    """A head that stands where it stands, or fails."""

    def __init__(self, error: AdapterError | None = None) -> None:
        self.error = error

    async def move_to(self, *, pan_deg: float, tilt_deg: float, roll_deg: float = 0.0) -> HeadState:
        return await self.read()

    async def set_lens(self, *, zoom: float, focus: float) -> HeadState:
        return await self.read()

    async def read(self) -> HeadState:
        if self.error is not None:
            raise self.error
        return STATE

    async def close(self) -> None:
        pass


class Frames:
    """Two pictures."""

    def __init__(self) -> None:
        self.count = 0

    async def fetch(self) -> EncodedFrame:
        self.count += 1
        return EncodedFrame(PNG + bytes([self.count]), 1.25, 1.5, f"source {self.count}")

    async def close(self) -> None:
        pass


async def record(folder: Path, head: Head) -> None:
    recorder = Recorder(folder)
    recorded, frames = recorder.head(head), recorder.frames(Frames())
    await frames.fetch()
    await recorded.move_to(pan_deg=0.1 + 0.2, tilt_deg=-1.0)
    await frames.fetch()
    recorder.close()


def files_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


async def test_answers_and_pictures_come_back_to_the_last_digit(tmp_path: Path) -> None:
    await record(tmp_path, Head())
    replay = Replay(tmp_path)
    head, frames = replay.head(), replay.frames()
    assert replay.left == 3
    # The order between two ports is free.
    assert await head.move_to(pan_deg=0.1 + 0.2, tilt_deg=-1.0) == STATE
    assert await frames.fetch() == EncodedFrame(PNG + b"\x01", 1.25, 1.5, "source 1")
    assert await frames.fetch() == EncodedFrame(PNG + b"\x02", 1.25, 1.5, "source 2")
    assert replay.left == 0
    assert files_in(tmp_path) == ["000000.png", "000002.png", TRANSCRIPT_NAME]


async def test_another_call_is_told_and_leaves_the_place(tmp_path: Path) -> None:
    await record(tmp_path, Head())
    head = Replay(tmp_path).head()
    with pytest.raises(ReplayMismatch, match="pan_deg"):
        await head.move_to(pan_deg=0.3, tilt_deg=-1.0)
    with pytest.raises(ReplayMismatch, match="read"):
        await head.read()
    await head.move_to(pan_deg=0.1 + 0.2, tilt_deg=-1.0)
    with pytest.raises(ReplayMismatch, match="no further call"):
        await head.move_to(pan_deg=0.1 + 0.2, tilt_deg=-1.0)


@pytest.mark.parametrize(
    "error",
    [
        Refused("ERROR: NO", where="R3 at h:1", command="getValue"),
        TimedOut("getValue", 2.0, where="R3 at h:1"),
        Unreachable("gone", where="R3 at h:1"),
        ProtocolError("garbage"),
        UnsafeText("a quote"),
        BadPicture("cut", where="x"),
    ],
)
async def test_errors_come_back_with_type_and_facts(tmp_path: Path, error: AdapterError) -> None:
    recorder = Recorder(tmp_path)
    with pytest.raises(type(error)):
        await recorder.head(Head(error)).read()
    recorder.close()
    with pytest.raises(type(error)) as caught:
        await Replay(tmp_path).head().read()
    assert str(caught.value) == str(error)
    assert vars(caught.value) == vars(error)


async def test_a_folder_without_transcript_and_a_damaged_one_are_told(tmp_path: Path) -> None:
    with pytest.raises(ReplayMismatch, match="cannot be read"):
        Replay(tmp_path)
    for text in ("{", "[]", json.dumps({"call": 0}), "\x00"):
        (tmp_path / TRANSCRIPT_NAME).write_text(text + "\n")
        with pytest.raises(ReplayMismatch, match="is no transcript"):
            Replay(tmp_path)


async def test_a_missing_picture_is_told(tmp_path: Path) -> None:
    await record(tmp_path, Head())
    (tmp_path / "000000.png").unlink()
    with pytest.raises(ReplayMismatch, match="the picture cannot be read"):
        await Replay(tmp_path).frames().fetch()


async def test_a_transcript_is_never_written_over(tmp_path: Path) -> None:
    await record(tmp_path, Head())
    with pytest.raises(FileExistsError):
        Recorder(tmp_path)
