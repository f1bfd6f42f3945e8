"""Every R3 command: its line as in the seed, its answers, what is refused."""

from __future__ import annotations

import base64
from typing import Any

import pytest

from engine_adapters.errors import BadPicture, ProtocolError, Refused, UnsafeText
from engine_adapters.r3 import commands
from engine_adapters.r3.protocol import PICTURE_LIMIT_BYTES, Command, Exchange, TimeoutClass

PNG = b"\x89PNG\r\n\x1a\n" + bytes(500) + b"IEND\xaeB`\x82"


def answer(command: Command[Any], *lines: str) -> Any:
    exchange = Exchange(command)
    assert exchange.feed("".join(f"{line}\n" for line in lines).encode())
    return exchange.result()


# The commands of the seed, 2.3.3, letter by letter.
@pytest.mark.parametrize(
    ("command", "line"),
    [
        (commands.take_snapshot("JornalNoiteTicker"), 'engine.takeSnapshot "JornalNoiteTicker"'),
        (
            commands.take_snapshot("C:/Users/john.doe/Desktop/JornalNoiteTicker"),
            'engine.takeSnapshot "C:/Users/john.doe/Desktop/JornalNoiteTicker"',
        ),
        (commands.get_snapshot("JornalNoiteTicker"), 'engine.getSnapshot "JornalNoiteTicker"'),
        (commands.get_tracking("Cam0"), 'engine.tracking "Cam0" get'),
        (
            commands.set_value("project_ref/scene_ref", "export_name", "value"),
            'scene "project_ref/scene_ref" export "export_name" SetValue "value"',
        ),
        (
            commands.rename("project_ref/scene_ref", "export_name", "new_name"),
            'scene "project_ref/scene_ref" export "export_name" rename "new_name"',
        ),
        (
            commands.get_value("project_ref/scene_ref", "export_name"),
            'scene "project_ref/scene_ref" export "export_name" getValue',
        ),
        (
            commands.multi_export(
                "JornalNoite/teste", [("transform.scale", "1,2,1"), ("text", "player_name"), ("alpha", "0.5")]
            ),
            'scene "JornalNoite/teste" export "transform.scale" SetValue "1,2,1" '
            '"text" SetValue "player_name" "alpha" SetValue "0.5"',
        ),
    ],
)
def test_lines_are_the_seeds(command: Command[Any], line: str) -> None:
    assert command.line == line


def test_each_command_knows_its_reply_bound_and_whether_it_may_be_repeated() -> None:
    multi = commands.multi_export("p/s", [("a", "1"), ("b", "2"), ("c", "3")])
    picture = commands.get_snapshot("a")
    assert multi.reply_lines == 3
    assert commands.set_value("p/s", "a", "1").reply_lines == 1
    assert picture.reply_limit_bytes == PICTURE_LIMIT_BYTES > multi.reply_limit_bytes
    assert picture.timeout_class is TimeoutClass.PICTURE
    assert commands.take_snapshot("a").timeout_class is TimeoutClass.SNAPSHOT
    assert multi.repeatable
    assert not commands.rename("p/s", "a", "b").repeatable


@pytest.mark.parametrize("dash", ["-", "\u2013", "\u2014"])
@pytest.mark.parametrize("quote", ["", '"'])
def test_errors_are_told_with_any_dash_and_with_the_seeds_quotes(dash: str, quote: str) -> None:
    with pytest.raises(Refused) as caught:
        answer(commands.take_snapshot("a"), f"{quote}ERROR: SNAPSHOT {dash} INVALID PATH{quote}")
    assert caught.value.answer == f"ERROR: SNAPSHOT {dash} INVALID PATH"
    assert caught.value.command == 'engine.takeSnapshot "a"'


@pytest.mark.parametrize("text", ["COULD NOT READ LAST SNAPSHOT FILE", "INVALID PATH"])
def test_get_snapshot_errors(text: str) -> None:
    with pytest.raises(Refused, match=text):
        answer(commands.get_snapshot("a"), f"ERROR: GETSNAPSHOT - {text}")


@pytest.mark.parametrize(
    "reply", ["OK: SCENE EXPORT SETVALUE - Value Set.", '"ok: scene export setvalue \u2013 value set"']
)
def test_a_set_value_is_acknowledged(reply: str) -> None:
    assert answer(commands.set_value("p/s", "a", "1"), reply) is None


@pytest.mark.parametrize("reply", ["OK", "OK: SNAPSHOT TAKEN", "", "HTTP/1.1 400 Bad Request", "0.5"])
def test_a_set_value_takes_no_other_reply(reply: str) -> None:
    with pytest.raises(ProtocolError, match="is not an answer to"):
        answer(commands.set_value("p/s", "a", "1"), reply)


@pytest.mark.parametrize(
    ("reply", "value"),
    [
        ("OK: SCENE EXPORT GETVALUE - -0.191619", "-0.191619"),
        ("OK: SCENE EXPORT GETVALUE \u2013 1,2,1", "1,2,1"),
        ('"OK: SCENE EXPORT GETVALUE - player name"', "player name"),
        ('OK: SCENE EXPORT GETVALUE - "12"', "12"),
        ("OK: SCENE EXPORT GETVALUE: -3", "-3"),
        ("OK: SCENE EXPORT GETVALUE - ", ""),
        ("OK: -0.5", "-0.5"),
        ('"-0.5"', "-0.5"),
    ],
)
def test_a_value_is_read_in_each_tolerated_form(reply: str, value: str) -> None:
    assert answer(commands.get_value("p/s", "a"), reply) == value


@pytest.mark.parametrize("reply", ["OK: SCENE EXPORT GETVALUE -0.5", "-0.5", "OK: SNAPSHOT TAKEN", "OK: <IMAGE> x"])
def test_a_reply_that_can_be_mistaken_is_no_value(reply: str) -> None:
    with pytest.raises(ProtocolError):
        answer(commands.get_value("p/s", "a"), reply)


@pytest.mark.parametrize(
    ("form", "reply", "value"),
    [
        ("prefixed", "OK: SCENE EXPORT GETVALUE - 1", "1"),
        ("prefixed", "OK: 1", None),
        ("ok", "OK: 1", "1"),
        ("ok", '"1"', None),
        ("bare", "1", "1"),
        ("bare", '"1"', "1"),
    ],
)
def test_the_profile_can_pin_the_form_of_values(form: commands.GetValueReply, reply: str, value: str | None) -> None:
    command = commands.get_value("p/s", "a", reply=form)
    if value is None:
        with pytest.raises(ProtocolError):
            answer(command, reply)
    else:
        assert answer(command, reply) == value


def test_multi_export_names_each_export_that_was_refused() -> None:
    command = commands.multi_export("p/s", [("a", "1"), ("b", "2"), ("c", "3")])
    set_line = "OK: SCENE EXPORT SETVALUE - Value Set."
    assert answer(command, set_line, set_line, set_line) is None
    with pytest.raises(Refused, match=r"2 of 3: a, c"):
        answer(command, "ERROR: NOT FOUND", set_line, "ERROR: NOT FOUND")
    with pytest.raises(ProtocolError):
        answer(command, set_line, "OK: SNAPSHOT TAKEN", set_line)


def test_rename_takes_any_ok_that_is_no_other_commands() -> None:
    command = commands.rename("p/s", "a", "b")
    assert answer(command, "OK: SCENE EXPORT RENAME - Renamed.") == "OK: SCENE EXPORT RENAME - Renamed."
    with pytest.raises(ProtocolError):
        answer(command, "OK: SCENE EXPORT SETVALUE - Value Set.")
    with pytest.raises(Refused):
        answer(command, "ERROR: SCENE EXPORT RENAME - NAME EXISTS")


@pytest.mark.parametrize(
    "lines",
    [
        ['OK: CURRENT CAMERA PARAMETERS: {"FovX": 80.0, "PosX": -1.5, "View": [[1, 0], [0, 1]]}'],
        ['OK: CURRENT CAMERA PARAMETERS: "FovX": 80.0, "PosX": -1.5'],
        ['OK: CURRENT CAMERA PARAMETERS: "FovX": 80.0, "PosX": -1.5, ...'],
        ["OK: CURRENT CAMERA PARAMETERS:", "{", '  "FovX": 80.0,', '  "Position": {"PosX": -1.5}', "}"],
        ["OK: CURRENT CAMERA PARAMETERS:", '"View": [[1,', "0]],", '"FovX": "80.0",', '"PosX": -15e-1'],
        ['"OK: CURRENT CAMERA PARAMETERS:"', '{"FovX": 80.0, "PosX": -1.5, "Note": "a } in a text"}'],
        ["OK: Current Camera Parameters:", "", '{"fovx": 80, "PosX": -1.5}'],
    ],
)
def test_tracking_is_read_in_each_tolerated_form(lines: list[str]) -> None:
    numbers = answer(commands.get_tracking("Cam0"), *lines)
    assert numbers["FOVX"] == 80.0
    assert numbers["POSX"] == -1.5


@pytest.mark.parametrize("text", ['"PosX": 1, "PosX": 2', '"PosX": 1e999'])
def test_tracking_numbers_that_contradict_or_overflow_are_refused(text: str) -> None:
    with pytest.raises(ProtocolError):
        answer(commands.get_tracking("Cam0"), f"OK: CURRENT CAMERA PARAMETERS: {{{text}}}")


def test_tracking_leaves_out_what_is_no_number() -> None:
    text = 'OK: CURRENT CAMERA PARAMETERS: {"PosX": NaN, "PosY": null, "PosZ": "x", "FovX": 80}'
    assert answer(commands.get_tracking("Cam0"), text) == {"FOVX": 80.0}


@pytest.mark.parametrize("form", ["OK: <IMAGE> {} <IMAGE>", "OK: <IMAGE>{}</IMAGE>", '"OK: <IMAGE> {} <IMAGE>"'])
def test_a_snapshot_is_the_picture_file(form: str) -> None:
    assert answer(commands.get_snapshot("a"), form.format(base64.b64encode(PNG).decode())) == PNG


def test_a_snapshot_may_be_broken_into_lines() -> None:
    lines = base64.encodebytes(PNG).decode().split()
    assert answer(commands.get_snapshot("a"), "OK: <IMAGE>", *lines, "<IMAGE>") == PNG


@pytest.mark.parametrize(
    "data",
    [b"", b"GIF89a", PNG[:-1], PNG[:100], b"\xff\xd8\xff" + bytes(50)],
    ids=["empty", "gif", "cut", "half", "jpeg"],
)
def test_a_snapshot_that_is_no_whole_picture_is_refused(data: bytes) -> None:
    with pytest.raises(BadPicture):
        answer(commands.get_snapshot("a"), f"OK: <IMAGE> {base64.b64encode(data).decode()} <IMAGE>")


def test_a_snapshot_that_is_no_base64_is_refused() -> None:
    with pytest.raises(BadPicture, match="not base64"):
        answer(commands.get_snapshot("a"), "OK: <IMAGE> %%%% <IMAGE>")


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (80.0, "80.0"),
        (80, "80.0"),
        (-0.0, "0.0"),
        (1e-7, "0.0000001"),
        (-0.191619, "-0.191619"),
        (1e22, "10000000000000000000000.0"),
        (0.1 + 0.2, "0.30000000000000004"),
    ],
)
def test_numbers_are_plain_digits(number: float, text: str) -> None:
    assert commands.number_text("n", number) == text


@pytest.mark.parametrize("number", [float("nan"), float("inf"), float("-inf"), 10**400])
def test_numbers_that_are_none_are_refused(number: float) -> None:
    with pytest.raises(UnsafeText):
        commands.number_text("n", number)


@pytest.mark.parametrize("count", [0, 257])
def test_multi_export_has_at_least_one_and_a_bounded_number_of_exports(count: int) -> None:
    with pytest.raises(UnsafeText):
        commands.multi_export("p/s", [("a", "1")] * count)


@pytest.mark.parametrize("name", ["", "x" * 201, "a\tb", 'a"b', "a\u201cb", "a\ud800b"])
def test_names_are_refused_with_what_is_wrong(name: str) -> None:
    with pytest.raises(UnsafeText, match="export name"):
        commands.get_value("p/s", name)


def test_overlong_values_are_refused_and_empty_ones_sent() -> None:
    with pytest.raises(UnsafeText, match="at most 4096"):
        commands.set_value("p/s", "a", "x" * 4097)
    assert commands.set_value("p/s", "a", "").line.endswith('SetValue ""')


@pytest.mark.parametrize(
    "name",
    [
        "//stranger/share/x",
        "\\\\stranger\\share",
        "../x",
        "a/../../x",
        "C:../x",
        "C:x",
        "a:stream",
        "file://x/y",
        "a//b",
        "CON",
        "dir/nul.txt",
        "a*",
        "%TEMP%/x",
        "a ",
        "C:/",
        "/",
    ],
)
def test_snapshot_names_stay_on_the_engines_own_disk(name: str) -> None:
    with pytest.raises(UnsafeText):
        commands.take_snapshot(name)
