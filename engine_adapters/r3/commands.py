"""Every command of the R3 text socket: one encoder, one parser each (seed 2.3.3).

Names and values go between double quotes. Whatever could end the quotes or the line is refused
(``UnsafeText``), never escaped: how the engine would read an escape is not known.
"""

from __future__ import annotations

import binascii
import math
import re
import unicodedata
from collections.abc import Sequence
from decimal import Decimal
from functools import partial
from typing import Literal

from engine_adapters.errors import BadPicture, ProtocolError, Refused, UnsafeText
from engine_adapters.pictures import check_whole, decode_base64
from engine_adapters.r3.protocol import (
    PICTURE_LIMIT_BYTES,
    Command,
    Lines,
    Picture,
    Structure,
    TimeoutClass,
    plain,
)

NAME_LIMIT_CHARS = 200
VALUE_LIMIT_CHARS = 4096
EXPORTS_LIMIT = 256
"""Most exports in one MultiExport: a line stays under 1.1 MB."""

GetValueReply = Literal["tolerant", "prefixed", "ok", "bare"]
"""How getValue is answered: ``OK: SCENE EXPORT GETVALUE - value``, ``OK: value``, the bare value, or any of them."""

_VALUE_SET = plain("OK: SCENE EXPORT SETVALUE - Value Set.")
_SNAPSHOT_TAKEN = plain("OK: SNAPSHOT TAKEN")
_TRACKING = re.compile(r'^(")?\s*OK:\s*CURRENT\s+CAMERA\s+PARAMETERS:?(?(1)"?)', re.IGNORECASE)
# The dash must stand alone: in "GETVALUE -0.5" it could be the separator or the sign, and a lost sign is a wrong lens.
_GET_VALUE = re.compile(
    "^OK:\\s*SCENE\\s+EXPORT\\s+GETVALUE(?:\\s*:|\\s+[-\u2010-\u2015])(?:\\s+(.*))?$", re.IGNORECASE
)
_OTHER_REPLIES = re.compile(r"^(OK:?\s*)?(SCENE\s+EXPORT\b|SNAPSHOT\b|CURRENT\s+CAMERA\b|</?IMAGE>)", re.IGNORECASE)
_NUMBER_FIELD = re.compile(r'"?(\w+)"?\s*[:=]\s*"?([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)"?(?=\s*[,}\]]|\s*$)')
# Characters that Windows' conversion to an ANSI code page turns into a double quote.
_QUOTE_LOOKALIKES = frozenset('"\u02ba\u030e\u201c\u201d\u201e\u201f\u2033\u2036\u275d\u275e\u301d\u301e\u301f\uff02')
_UNSAFE_CATEGORIES = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
_DEVICE_NAMES = frozenset({"CON", "PRN", "AUX", "NUL"} | {f"{port}{n}" for port in ("COM", "LPT") for n in range(10)})


def safe_text(what: str, text: str, *, limit_chars: int = NAME_LIMIT_CHARS, empty: bool = False) -> str:
    """``text`` as given, if it can stand between double quotes. Raises ``UnsafeText``."""
    if not text and not empty:
        raise UnsafeText(f"{what} is empty; give it a name")
    if len(text) > limit_chars:
        raise UnsafeText(f"{what} has {len(text)} characters, at most {limit_chars} are sent")
    for character in text:
        if character in _QUOTE_LOOKALIKES or unicodedata.category(character) in _UNSAFE_CATEGORIES:
            raise UnsafeText(
                f"{what} = {text[:60]!r} holds {character!r}; quotes, line breaks and control characters are not sent"
            )
        if character == "\\":
            # The engine may read a backslash before the closing quote as an escape of it.
            raise UnsafeText(f"{what} = {text[:60]!r} holds a backslash; write / instead")
    return text


def number_text(what: str, value: float) -> str:
    """A finite number as plain decimal digits that read back to the same double: no exponent, no locale.

    Raises ``UnsafeText`` for NaN, infinities and numbers beyond a double.
    """
    try:
        number = float(value)
    except OverflowError as error:
        raise UnsafeText(f"{what} is beyond the range of a number") from error
    if not math.isfinite(number):
        raise UnsafeText(f"{what} = {number}: must be a finite number")
    if number == 0.0:
        return "0.0"
    text = format(Decimal(repr(number)), "f")
    return text if "." in text else f"{text}.0"


def take_snapshot(name: str) -> Command[None]:
    """``engine.takeSnapshot``: the engine writes a PNG to its disk, about 0.3 s."""
    line = f'engine.takeSnapshot "{snapshot_name(name)}"'
    return _acknowledged(line, "takeSnapshot", _SNAPSHOT_TAKEN, TimeoutClass.SNAPSHOT)


def get_snapshot(name: str) -> Command[bytes]:
    """``engine.getSnapshot``: the picture file of a snapshot taken before."""
    line = f'engine.getSnapshot "{snapshot_name(name)}"'
    return Command(
        line=line,
        name="getSnapshot",
        shape=Picture,
        parse=partial(_parse_picture, line),
        reply_lines=None,
        reply_limit_bytes=PICTURE_LIMIT_BYTES,
        timeout_class=TimeoutClass.PICTURE,
    )


def get_tracking(camera: str) -> Command[dict[str, float]]:
    """``engine.tracking "camera" get``: every number of the current packet, by its name in upper case."""
    line = f'engine.tracking "{safe_text("tracking camera", camera)}" get'
    return Command(
        line=line,
        name="tracking get",
        shape=partial(Structure, _TRACKING),
        parse=partial(_parse_tracking, line),
        reply_lines=None,
    )


def set_value(scene: str, export: str, value: str) -> Command[None]:
    """``SetValue`` of one export."""
    line = f"{_export(scene, export)} SetValue {_value(export, value)}"
    return _acknowledged(line, "SetValue", _VALUE_SET)


def get_value(scene: str, export: str, *, reply: GetValueReply = "tolerant") -> Command[str]:
    """``getValue`` of one export, as text exactly as the engine gives it."""
    line = f"{_export(scene, export)} getValue"
    return Command(line=line, name="getValue", shape=partial(Lines, 1), parse=partial(_parse_value, line, reply))


def rename(scene: str, export: str, new_name: str) -> Command[str]:
    """``rename`` of one export; gives the engine's answer. Not repeatable: the old name is gone afterwards."""
    line = f'{_export(scene, export)} rename "{safe_text("new name", new_name)}"'
    return Command(
        line=line,
        name="rename",
        shape=partial(Lines, 1),
        parse=partial(_parse_renamed, line),
        repeatable=False,
    )


def multi_export(scene: str, values: Sequence[tuple[str, str]]) -> Command[None]:
    """Several exports of a scene set in one line, which the engine answers with one line for each of them."""
    if not 1 <= len(values) <= EXPORTS_LIMIT:
        raise UnsafeText(f"MultiExport of {len(values)} exports: 1 to {EXPORTS_LIMIT} are sent in one line")
    names = [name for name, _ in values]
    pairs = " ".join(f'"{safe_text("export name", name)}" SetValue {_value(name, value)}' for name, value in values)
    line = f'scene "{safe_text("scene", scene)}" export {pairs}'
    return Command(
        line=line,
        name="MultiExport",
        shape=partial(Lines, len(values)),
        parse=partial(_parse_multi, names),
        reply_lines=len(values),
    )


def snapshot_name(name: str) -> str:
    """A snapshot's name or path on the engine's own disk.

    Refused besides unsafe text: another machine's share (it would make the engine's host contact a stranger),
    steps upwards, streams, device names, wildcards.
    """
    text = safe_text("snapshot name", name)
    rest = text[2:] if re.match(r"^[A-Za-z]:/", text) else text
    parts = rest.strip("/").split("/")
    if (
        text.startswith("//")
        or "//" in rest
        or any(c in ":*?<>|%" for c in rest)
        or any(part != part.strip(" .") or part.split(".")[0].upper() in _DEVICE_NAMES for part in parts)
        or not all(parts)
    ):
        raise UnsafeText(f"snapshot name = {text[:60]!r} must be a plain name or a path on the engine's own disk")
    return text


def _export(scene: str, export: str) -> str:
    return f'scene "{safe_text("scene", scene)}" export "{safe_text("export name", export)}"'


def _value(export: str, value: str) -> str:
    return f'"{safe_text(f"value of {export}", value, limit_chars=VALUE_LIMIT_CHARS, empty=True)}"'


def _acknowledged(
    line: str, name: str, expected: str, timeout_class: TimeoutClass = TimeoutClass.COMMAND
) -> Command[None]:
    return Command(
        line=line,
        name=name,
        shape=partial(Lines, 1),
        parse=partial(_parse_acknowledged, line, expected),
        timeout_class=timeout_class,
    )


def refusal(line: str, *, command: str) -> Refused | None:
    """The error that a reply line tells, if it tells one."""
    text = line.strip().strip('"').strip()
    return Refused(text, command=command) if plain(line).startswith("ERROR") else None


def _parse_acknowledged(command: str, expected: str, lines: Sequence[str]) -> None:
    (line,) = lines
    if error := refusal(line, command=command):
        raise error
    # A final full stop is a matter of taste, anything else is another command's reply.
    if plain(line).rstrip(". ") != expected.rstrip(". "):
        raise _unexpected(line, command)


def _parse_multi(names: Sequence[str], lines: Sequence[str]) -> None:
    refused: list[tuple[str, Refused]] = []
    for name, line in zip(names, lines, strict=True):
        command = f'MultiExport "{name}"'
        try:
            _parse_acknowledged(command, _VALUE_SET, [line])
        except Refused as error:
            refused.append((name, error))
    if refused:
        listed = ", ".join(name for name, _ in refused)
        raise Refused(refused[0][1].answer, command=f"MultiExport ({len(refused)} of {len(names)}: {listed})")


def _parse_value(command: str, reply: GetValueReply, lines: Sequence[str]) -> str:
    (line,) = lines
    text = line.strip()
    whole = text.strip('"')
    if error := refusal(line, command=command):
        raise error
    if reply in ("tolerant", "prefixed") and (found := _GET_VALUE.match(whole)):
        return (found[1] or "").strip().strip('"')
    # Another command's late reply must never pass for a value.
    if reply == "prefixed" or _OTHER_REPLIES.match(whole):
        raise _unexpected(line, command)
    if reply in ("tolerant", "ok") and whole.upper().startswith("OK:"):
        return whole[3:].strip().strip('"')
    bare = len(text) >= 2 and text.startswith('"') and text.endswith('"')
    if reply == "bare" or (reply == "tolerant" and bare):
        return whole
    raise _unexpected(line, command)


def _parse_renamed(command: str, lines: Sequence[str]) -> str:
    (line,) = lines
    if error := refusal(line, command=command):
        raise error
    answer = plain(line)
    # The seed does not tell this answer's words; only what can be another command's is turned away.
    if not answer.startswith("OK") or answer.startswith((_VALUE_SET.rstrip("."), _SNAPSHOT_TAKEN, "OK: <IMAGE>")):
        raise _unexpected(line, command)
    return line.strip()


def _parse_picture(command: str, lines: Sequence[str]) -> bytes:
    if error := refusal(lines[0][:1000], command=command):
        raise error
    text = "".join(lines).strip().strip('"')
    found = re.match(r"OK:\s*<IMAGE>", text[:40], re.IGNORECASE)
    closing = re.search(r"</?IMAGE>$", text[-20:].rstrip(), re.IGNORECASE)
    if found is None or closing is None:
        raise _unexpected(lines[0], command)
    end = text.rindex("<")
    try:
        data = decode_base64(text[found.end() : end].encode("ascii"))
    except (binascii.Error, UnicodeEncodeError) as error:
        raise BadPicture("the snapshot is not base64 text") from error
    check_whole(data, where="getSnapshot")
    return data


def _parse_tracking(command: str, lines: Sequence[str]) -> dict[str, float]:
    if error := refusal(lines[0], command=command):
        raise error
    text = "\n".join(lines).strip()
    found = _TRACKING.match(text)
    if found is None:
        raise _unexpected(lines[0], command)
    numbers: dict[str, float] = {}
    for name, digits in _NUMBER_FIELD.findall(text[found.end() :]):
        value = float(digits)
        if not math.isfinite(value):
            raise ProtocolError(f"{name} = {digits} in the tracking packet is no usable number")
        if numbers.setdefault(name.upper(), value) != value:
            raise ProtocolError(f"the tracking packet gives {name} twice, as {numbers[name.upper()]:g} and {value:g}")
    return numbers


def _unexpected(line: str, command: str) -> ProtocolError:
    return ProtocolError(f"{line[:120]!r} is not an answer to {command[:120]}")
