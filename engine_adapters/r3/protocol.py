"""The R3 wire format, without I/O: bytes in, reply lines and typed answers out.

Replies are lines ended by LF (CRLF is accepted). How many lines belong to a command is the command's business
(:mod:`engine_adapters.r3.commands`): a :class:`ReplyShape` takes line after line and says when the reply is
whole. Every reply has a limit in bytes. Any chunking of the same bytes gives the same events.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Generic, Protocol, TypeVar

from engine_adapters.errors import ProtocolError, UnsafeText

T = TypeVar("T")

REPLY_LIMIT_BYTES = 1024 * 1024
"""Largest reply of everything but pictures: a tracking packet is under 2 KiB."""

PICTURE_LIMIT_BYTES = 64 * 1024 * 1024
"""Largest picture reply: a noisy 8K PNG in base64 stays below it."""

_DASHES = re.compile("[\u2010-\u2015\u2212]")


class ReplyShape(Protocol):
    """Takes the lines of one reply; True when the reply is whole."""

    def take(self, line: str) -> bool:
        """Take the next line (without its line end)."""
        ...


class Lines:
    """A reply of a known number of lines (MultiExport: one for each export)."""

    def __init__(self, count: int) -> None:
        self._left = count

    def take(self, line: str) -> bool:
        """True with the last line."""
        self._left -= 1
        return self._left <= 0


class Structure:
    """A line that announces a JSON-like structure, which may stand on that line or on the ones after it.

    The reply ends with the first line that leaves no bracket open and does not end with a comma, so outer
    braces may be missing. A first line without the announcement (an error) is the whole reply.
    """

    def __init__(self, announcement: re.Pattern[str]) -> None:
        self._announcement = announcement
        self._announced = False
        self._depth = 0

    def take(self, line: str) -> bool:
        """True when the structure is closed."""
        text = line.strip()
        if not self._announced:
            found = self._announcement.match(text)
            if found is None:
                return True
            self._announced = True
            text = text[found.end() :].strip()
        if not text:
            return False
        quoted = False
        for mark in re.findall(r'[{}\[\]"]', text):
            if mark == '"':
                quoted = not quoted
            elif not quoted:
                self._depth += 1 if mark in "{[" else -1
        return self._depth <= 0 and not text.endswith(",")


class Picture:
    """``OK: <IMAGE> base64 <IMAGE>`` on one line, or broken over several; an error is one line."""

    _TAG = re.compile(r"</?IMAGE>", re.IGNORECASE)

    def __init__(self) -> None:
        self._tags = 0

    def take(self, line: str) -> bool:
        """True with the closing tag."""
        opened = self._tags > 0
        # Only the line's ends can hold tags: searching megabytes of base64 for them would cost milliseconds.
        self._tags += sum(len(self._TAG.findall(end)) for end in _ends(line))
        return self._tags >= 2 or not (opened or self._tags)


def _ends(line: str, size: int = 40) -> tuple[str, ...]:
    return (line,) if len(line) <= 2 * size else (line[:size], line[-size:])


def plain(text: str) -> str:
    """A reply line for comparing: outer quotes off, every dash a hyphen, spaces single, upper case."""
    return " ".join(_DASHES.sub("-", text.strip().strip('"')).split()).upper()


class TimeoutClass(StrEnum):
    """Which bound of the profile a command's exchange has."""

    COMMAND = "command"
    SNAPSHOT = "snapshot"
    """The engine renders and writes a file: about 0.3 s."""
    PICTURE = "picture"
    """Megabytes come back."""


@dataclass(frozen=True)
class Command(Generic[T]):
    """One command: its line, what its reply looks like, and how to read it.

    ``parse`` gets the reply's lines and returns the typed answer, or raises ``Refused`` (the engine said no; the
    connection stays good) or ``ProtocolError`` (not this command's reply). ``repeatable``: sending it twice
    has the same effect as once, so that a goal whose reply was lost may be stated again.
    """

    line: str
    name: str
    shape: Callable[[], ReplyShape] = field(repr=False)
    parse: Callable[[Sequence[str]], T] = field(repr=False)
    reply_lines: int | None = 1
    """Number of lines in the reply; None where the reply itself tells its end."""
    reply_limit_bytes: int = REPLY_LIMIT_BYTES
    timeout_class: TimeoutClass = TimeoutClass.COMMAND
    repeatable: bool = True

    def encode(self, *, encoding: str = "utf-8", line_ending: str = "\n") -> bytes:
        """The bytes to send: exactly one line. Raises ``UnsafeText`` where the encoding cannot say it."""
        try:
            return self.line.encode(encoding) + line_ending.encode(encoding)
        except UnicodeEncodeError as error:
            raise UnsafeText(
                f"{self.line[error.start : error.end]!r} cannot be written in {encoding}; rename it in the engine"
            ) from error


class LineSplitter:
    """Bytes to text lines, with a limit on what is kept back and on the sum of what was fed."""

    def __init__(self, *, encoding: str = "utf-8", limit_bytes: int = REPLY_LIMIT_BYTES) -> None:
        self._encoding = codecs.lookup(encoding).name
        self._limit_bytes = limit_bytes
        self._buffer = bytearray()
        self._searched = 0
        self.taken_bytes = 0
        """Bytes of the lines given out so far, line ends included."""

    def feed(self, data: bytes) -> None:
        """Add what came from the socket."""
        self._buffer += data

    def next_line(self) -> str | None:
        """The next whole line without its line end, or None until more bytes come. Raises ``ProtocolError``."""
        end = self._buffer.find(b"\n", self._searched)
        size = len(self._buffer) if end < 0 else end + 1
        if self.taken_bytes + size > self._limit_bytes:
            raise ProtocolError(f"the answer is larger than its limit of {self._limit_bytes} bytes")
        if end < 0:
            # A line may arrive in thousands of pieces: each byte is searched once.
            self._searched = len(self._buffer)
            return None
        raw = bytes(self._buffer[:end])
        del self._buffer[:size]
        self._searched = 0
        self.taken_bytes += size
        return self._decode(raw.removesuffix(b"\r"))

    @property
    def surplus(self) -> bytes:
        """What was fed and not yet given out."""
        return bytes(self._buffer)

    def _decode(self, raw: bytes) -> str:
        try:
            text = raw.decode(self._encoding)
        except UnicodeDecodeError as error:
            raise ProtocolError(
                f"the answer is not {self._encoding} text: byte 0x{raw[error.start]:02x} at {error.start}; "
                "set r3.encoding of the studio profile, or check that R3 listens on this port"
            ) from error
        if "\x00" in text:
            raise ProtocolError("the answer holds NUL bytes; check that R3 listens on this port")
        return text


class Exchange(Generic[T]):
    """One command and its reply: feed bytes until :attr:`done`, then read :meth:`result`."""

    def __init__(self, command: Command[T], *, encoding: str = "utf-8", limit_bytes: int | None = None) -> None:
        self.command = command
        self.done = False
        self.lines: list[str] = []
        self._shape = command.shape()
        self._splitter = LineSplitter(encoding=encoding, limit_bytes=limit_bytes or command.reply_limit_bytes)

    def feed(self, data: bytes) -> bool:
        """Take bytes; True once the reply is whole. Raises ``ProtocolError``, also for bytes beyond the reply."""
        self._splitter.feed(data)
        while not self.done and (line := self._splitter.next_line()) is not None:
            self.lines.append(line)
            self.done = self._shape.take(line)
        if self.done and (surplus := self._splitter.surplus):
            raise ProtocolError(f"{len(surplus)} bytes more than the answer to {self.command.name}: {surplus[:40]!r}")
        return self.done

    def result(self) -> T:
        """The typed answer. Raises ``Refused`` or ``ProtocolError``."""
        return self.command.parse(self.lines)
