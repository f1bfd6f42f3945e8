"""Settings and studio profiles as a command line gives them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from app.cli.console import wrong_usage
from app.documents import one_line
from app.settings import PREFIX, Settings
from engine_adapters.profile import StudioProfile, load_profile


def build_settings(**given: Any) -> Settings:
    """The settings of the environment with those given on the command line (None: not); wrong ones exit with 2."""
    try:
        return Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        problem = one_line(error)
        name = problem.partition(":")[0].partition(".")[0]
        source = "the command line" if given.get(name) is not None else f"{PREFIX}{name.upper()}"
        wrong_usage(f"setting {problem}; it comes from {source}")


def chosen_profile(path: Path | None, settings: Settings) -> Path | None:
    """The profile's file: the one given, else the first of the settings; None: the defaults."""
    return path or next(iter(settings.profiles), None)


def studio_profile(path: Path | None, settings: Settings) -> tuple[StudioProfile, str]:
    """The profile to use and where it is from: the file given, else the first of the settings, else the defaults.

    Raises :class:`engine_adapters.profile.ProfileError`.
    """
    chosen = chosen_profile(path, settings)
    if chosen is None:
        return StudioProfile(), "the default profile, an engine on this host"
    return load_profile(chosen), str(chosen)
