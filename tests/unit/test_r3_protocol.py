"""The R3 wire format without sockets: lines, shapes, limits, any chunking."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine_adapters.errors import AdapterError, ProtocolError, UnsafeText
from engine_adapters.r3 import commands
from engine_adapters.r3.protocol import Command, Exchange, Lines, LineSplitter, plain

STREAMS: list[tuple[Command[Any], bytes]] = [
    (commands.get_value("p/s", "a"), b"OK: SCENE EXPORT GETVALUE - -0.5\r\n"),
    (commands.get_value("p/s", "a"), "ERROR: UNKNOWN – EXPORT\n".encode()),
    (commands.get_value("p/s", "a"), b"\xff\xfe garbage\n"),
    (commands.multi_export("p/s", [("a", "1"), ("b", "2")]), b"OK: SCENE EXPORT SETVALUE - Value Set.\n" * 2),
    (commands.get_tracking("Cam0"), b'OK: CURRENT CAMERA PARAMETERS: "FovX": 80.0, "FovY": 50.0, "PosX": 1\n'),
    (commands.get_tracking("Cam0"), b'OK: CURRENT CAMERA PARAMETERS:\n{\n"M": [[1,\n2]],\n"FovX": 80.0\n}\n'),
    (commands.get_snapshot("a"), b"OK: <IMAGE> AAAA\nBBBB <IMAGE>\n"),
]


def outcome(command: Command[Any], stream: bytes, cuts: list[int]) -> tuple[str, object]:
    exchange = Exchange(command)
    edges = [0, *sorted({min(cut, len(stream)) for cut in cuts}), len(stream)]
    try:
        for start, end in itertools.pairwise(edges):
            exchange.feed(stream[start:end])
        return ("done", exchange.result()) if exchange.done else ("waiting", tuple(exchange.lines))
    except AdapterError as error:
        return type(error).__name__, str(error)


@pytest.mark.parametrize(("command", "stream"), STREAMS)
@given(cuts=st.lists(st.integers(0, 80), max_size=12))
def test_any_chunking_gives_the_same(command: Command[Any], stream: bytes, cuts: list[int]) -> None:
    assert outcome(command, stream, cuts) == outcome(command, stream, [])


@pytest.mark.parametrize(("command", "stream"), STREAMS)
def test_a_reply_is_whole_with_its_last_byte_and_not_before(command: Command[Any], stream: bytes) -> None:
    exchange = Exchange(command, encoding="latin-1")
    assert not exchange.feed(stream[:-1])
    assert exchange.feed(stream[-1:])


def test_line_ends_may_be_lf_or_crlf_and_may_be_split() -> None:
    splitter = LineSplitter()
    lines = []
    for chunk in (b"one\r", b"\ntwo\n", b"", b"thr", b"ee\r\n\r\n"):
        splitter.feed(chunk)
        while (line := splitter.next_line()) is not None:
            lines.append(line)
    assert lines == ["one", "two", "three", ""]
    assert splitter.surplus == b""


def test_a_character_split_between_chunks_is_whole() -> None:
    splitter = LineSplitter()
    splitter.feed("–\n".encode()[:2])
    assert splitter.next_line() is None
    splitter.feed("–\n".encode()[2:])
    assert splitter.next_line() == "–"


@pytest.mark.parametrize("size", [9, 10])
def test_the_limit_counts_every_byte_up_to_the_line_end(size: int) -> None:
    splitter = LineSplitter(limit_bytes=10)
    splitter.feed(b"x" * size + b"\n")
    if size == 9:
        assert splitter.next_line() == "x" * 9
    else:
        with pytest.raises(ProtocolError, match="limit of 10 bytes"):
            splitter.next_line()


def test_the_limit_counts_over_all_lines() -> None:
    splitter = LineSplitter(limit_bytes=10)
    splitter.feed(b"1234\n1234\n")
    assert [splitter.next_line(), splitter.next_line()] == ["1234", "1234"]
    splitter.feed(b"x")
    with pytest.raises(ProtocolError):
        splitter.next_line()


def test_a_line_without_end_is_refused_at_the_limit() -> None:
    exchange = Exchange(commands.get_value("p/s", "a"), limit_bytes=1000)
    exchange.feed(b"x" * 1000)
    with pytest.raises(ProtocolError, match="larger than its limit"):
        exchange.feed(b"x")


@pytest.mark.parametrize("data", [b"\xff\n", b"\xc3\n", b"a\x00b\n"])
def test_bytes_that_are_no_text_are_refused(data: bytes) -> None:
    splitter = LineSplitter()
    splitter.feed(data)
    with pytest.raises(ProtocolError):
        splitter.next_line()


def test_more_than_the_reply_is_refused() -> None:
    exchange = Exchange(commands.take_snapshot("a"))
    with pytest.raises(ProtocolError, match="more than the answer to takeSnapshot"):
        exchange.feed(b"OK: SNAPSHOT TAKEN\nOK")


def test_lines_counts() -> None:
    shape = Lines(3)
    assert [shape.take("a"), shape.take("b"), shape.take("c")] == [False, False, True]


def test_plain_levels_dashes_quotes_spaces_and_case() -> None:
    assert plain('  "ERROR: Snapshot  –  Invalid Path" ') == plain("ERROR: SNAPSHOT - INVALID PATH")


def test_a_line_is_one_line_in_the_asked_encoding() -> None:
    command = commands.get_value("Estúdio/Calibração", "k1")
    assert command.encode() == 'scene "Estúdio/Calibração" export "k1" getValue\n'.encode()
    assert command.encode(encoding="cp1252", line_ending="\r\n").endswith(b'" getValue\r\n')
    with pytest.raises(UnsafeText, match="cannot be written in latin-1"):
        commands.get_value("p/s", "日本").encode(encoding="latin-1")
