"""The settings: read once from the environment, refused with the field's name, documented."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import ValidationError

from app.settings import PREFIX, Settings, default_cpu_workers, reference_text


@pytest.fixture(autouse=True)
def _no_settings_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(os.environ):
        if name.startswith(PREFIX):
            monkeypatch.delenv(name)


def test_defaults_are_safe_and_local() -> None:
    settings = Settings()
    assert settings.host == "127.0.0.1"
    assert settings.database.name == "lensmatch.db"
    assert settings.database.is_absolute()
    assert settings.allowed_origins == ()
    assert settings.cpu_workers == default_cpu_workers() >= 1


def test_the_environment_is_read_when_settings_are_made(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LENSMATCH_PORT", "8123")
    monkeypatch.setenv("LENSMATCH_DATABASE", str(tmp_path / "a.db"))
    monkeypatch.setenv("LENSMATCH_PROFILES", os.pathsep.join(["one.toml", "two.toml"]))
    monkeypatch.setenv("LENSMATCH_ALLOWED_HOSTS", "studio.local, 127.0.0.1")
    monkeypatch.setenv("LENSMATCH_ALLOWED_ORIGINS", "https://Studio.example:8443")
    settings = Settings()
    assert settings.port == 8123
    assert settings.database == tmp_path / "a.db"
    assert settings.profiles == (Path("one.toml"), Path("two.toml"))
    assert settings.allowed_hosts == ("studio.local", "127.0.0.1")
    assert settings.allowed_origins == ("https://studio.example:8443",)


def test_what_is_given_wins_over_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LENSMATCH_PORT", "8123")
    assert Settings(port=9000).port == 9000


def test_settings_cannot_be_changed() -> None:
    settings = Settings()
    with pytest.raises(ValidationError):
        settings.port = 1


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("port", "70000"),
        ("port", "http"),
        ("max_body_bytes", "-1"),
        ("heartbeat_s", "nan"),
        ("heartbeat_s", "inf"),
        ("allowed_hosts", "*"),
        ("allowed_hosts", "http://studio"),
        ("allowed_hosts", "studio:8000"),
        ("allowed_origins", "studio.example"),
        ("allowed_origins", "https://studio.example/path"),
        ("allowed_origins", "null"),
        ("cpu_workers", "0"),
    ],
)
def test_a_wrong_value_is_refused_by_name(name: str, value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PREFIX + name.upper(), value)
    with pytest.raises(ValidationError) as refused:
        Settings()
    assert name in str(refused.value)


def test_a_setting_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ValidationError):
        Settings(prot=8000)  # type: ignore[call-arg]


def test_each_number_says_its_unit() -> None:
    units = {"_s": "seconds", "_bytes": "bytes"}
    for name, field in Settings.model_fields.items():
        assert field.description, name
        for suffix, unit in units.items():
            if name.endswith(suffix):
                assert unit in field.description, name


def test_importing_reads_nothing() -> None:
    code = "import os; os.environ['LENSMATCH_PORT'] = 'nonsense'; import app.settings"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr


def test_the_reference_is_current(repository: Path) -> None:
    page = repository / "docs" / "reference" / "settings.md"
    assert page.read_text("utf-8") == reference_text(), "run: python -m app.reference docs/reference"
