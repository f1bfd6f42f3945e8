"""The command line's help, wrong usage, and what the documentation says of it."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from app.cli.commands import cli
from app.cli.reference import reference_text
from engine_adapters.profile import StudioProfile, parse_profile
from engine_adapters.sim.process import SimulatorOptions

RUNNER = CliRunner()
COMMANDS = [info.name or getattr(info.callback, "__name__", "") for info in cli.registered_commands]


def invoke(*words: str | Path) -> Result:
    return RUNNER.invoke(cli, [str(word) for word in words])


def error_line(result: Result) -> str:
    """The one line on standard error that says what went wrong."""
    lines = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, result.stderr
    return lines[0]


def options_of(command: str) -> set[str]:
    section = reference_text().split(f"\n## lensmatch {command}\n")[1].split("\n## ")[0]
    return {"--help", *re.findall(r"--[a-z][a-z0-9-]+", section)}


def test_the_reference_is_current(repository: Path) -> None:
    """Where this fails after a change of a command: ``python -m app.cli.reference docs/reference/cli.md``."""
    assert (repository / "docs" / "reference" / "cli.md").read_text("utf-8") == reference_text()


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_its_options_and_examples(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    result = invoke(command, "--help")
    assert result.exit_code == 0
    assert f"lensmatch {command}" in result.stdout
    for option in options_of(command):
        assert option in result.stdout
    assert "--json" in result.stdout


def test_the_contracts_commands_are_there() -> None:
    wanted = {
        "demo",
        "serve",
        "simulate",
        "calibrate",
        "run",
        "detect",
        "export",
        "import",
        "publish",
        "bench",
        "doctor",
    }
    assert wanted <= set(COMMANDS)


def test_no_command_shows_the_help_and_is_wrong_usage() -> None:
    result = invoke()
    assert result.exit_code == 2
    assert "calibrate" in result.stdout


def test_the_version_is_printed() -> None:
    result = invoke("--version")
    assert result.exit_code == 0
    assert result.stdout.startswith("lensmatch ")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["paint"], "paint"),
        (["detect"], "PICTURE"),
        (["detect", "a.png"], "--target"),
        (["detect", "a.png", "--target", "chessboard:8"], "chessboard:COLSxROWS"),
        (["detect", "a.png", "--target", "chessboard:0x7"], "at least 3 x 3"),
        (["detect", "a.png", "--target", "circle"], "square, or light"),
        (["detect", "a.png", "--target", "light", "--transfer", "hlg"], "hlg"),
        (["calibrate", "x", "--method", "magic"], "magic"),
        (["calibrate", "x", "--colour", "red"], "--colour"),
        (["export", "t.json", "--format", "xyz", "--out", "o"], "there are: json, csv"),
        (["import", "t.json", "--format", "xyz"], "there are: json, csv"),
        (["bench", "nothing"], "there are: levels, "),
        (["simulate", "--fault", "r3:melt@1"], "no fault is called melt"),
        (["simulate", "--lens", "none such"], "no embedded lens"),
        (["simulate", "--r3-port", "70000"], "65535"),
        (["serve", "--port", "99999"], "65535"),
        (["demo", "--lens", "none such"], "no simulated lens"),
        (["doctor", "--print-profile", "--json"], "--print-profile"),
    ],
)
def test_wrong_usage_is_one_line_and_2(words: list[str], told: str) -> None:
    result = invoke(*words)
    assert result.exit_code == 2, result.output
    assert told in error_line(result)
    assert result.stdout == "" or "--json" in words
    assert len(result.stderr.splitlines()) == 1


def test_a_setting_that_cannot_be_used_names_its_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LENSMATCH_PORT", "many")
    result = invoke("serve")
    assert result.exit_code == 2
    assert "LENSMATCH_PORT" in error_line(result)


def test_the_printed_profile_is_the_default_one() -> None:
    result = invoke("doctor", "--print-profile")
    assert result.exit_code == 0
    assert parse_profile(result.stdout) == StudioProfile()
    assert result.stdout.count("#") > 30


def _documented() -> list[tuple[str, list[str]]]:
    repository = Path(__file__).resolve().parents[2]
    found = []
    for page in (repository / "README.md", *sorted((repository / "docs").rglob("*.md"))):
        for fence in re.findall(r"^ *```[a-z ]*\n(.*?)^ *```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL):
            for part in re.split(r"\n|&&", fence):
                if part.strip().startswith("lensmatch "):
                    words = shlex.split(part, comments=True)
                    found.append((f"{page.relative_to(repository).as_posix()}: {part.strip()}", words[1:]))
    return found


@pytest.mark.parametrize(("where", "words"), _documented(), ids=lambda value: value if isinstance(value, str) else "")
def test_commands_in_the_documentation_exist(where: str, words: list[str]) -> None:
    if words[0].startswith("-"):
        return
    assert words[0] in COMMANDS
    assert {word for word in words if word.startswith("--")} <= options_of(words[0])


def test_the_containers_profile_speaks_to_the_containers_studio(repository: Path) -> None:
    profile = parse_profile((repository / "docker" / "studio.toml").read_text("utf-8"))
    default = SimulatorOptions()
    assert profile.r3.port == default.r3_port
    assert f":{default.mockboard_port}/" in profile.mockboard.url
    assert profile.head.kind == "simulated"
    assert f":{default.head_port}/" in profile.head.url
    compose = (repository / "docker" / "compose.yaml").read_text("utf-8")
    for port in (default.r3_port, default.mockboard_port, default.head_port):
        assert f'"{port}"' in compose
    assert "LENSMATCH_PROFILES: /etc/lensmatch/studio.toml" in compose
    assert tomllib.loads((repository / "docker" / "studio.toml").read_text("utf-8"))
