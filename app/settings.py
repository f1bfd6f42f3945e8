"""Every setting of the service, in one frozen object that is read once and passed in.

A setting comes from the environment (``LENSMATCH_`` and its name in capitals) or from the command line; nothing is
read when this module is imported. ``docs/reference/settings.md`` is made from the fields below.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Annotated

import platformdirs
from pydantic import Field, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

PREFIX = "LENSMATCH_"
LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
MIB = 1024 * 1024
HOST_NAME = re.compile(r"\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+")
"""A name or address as it stands in a Host header, IPv6 in brackets, without the port."""


def default_database() -> Path:
    """The database in the user's data folder, as the system names it."""
    return platformdirs.user_data_path("lensmatch", appauthor=False) / "lensmatch.db"


def default_cpu_workers() -> int:
    """One for each processor, at least two, so that decoding a picture never waits for finding in the one before; at
    most eight."""
    return max(2, min(8, os.cpu_count() or 2))


class Settings(BaseSettings):
    """The service's settings. Raises :class:`pydantic.ValidationError` for a value that cannot be used."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, frozen=True, extra="forbid", validate_default=True)

    database: Path = Field(
        default_factory=default_database,
        description="SQLite file with jobs, events and lens tables; made if it is not there",
    )
    host: str = Field(default="127.0.0.1", min_length=1, max_length=255, description="address to listen on")
    port: int = Field(default=8000, ge=0, le=65535, description="TCP port to listen on; 0: any free one")
    profiles: Annotated[tuple[Path, ...], NoDecode] = Field(
        default=(),
        description="studio profiles (TOML), one for each engine, separated as in PATH (: or, on Windows, ;)",
    )
    allowed_hosts: Annotated[tuple[str, ...], NoDecode] = Field(
        default=LOOPBACK_NAMES,
        description="names under which the service may be called (Host header, without port), separated by commas; "
        "other names are refused, so that a foreign page cannot reach it through DNS",
    )
    allowed_origins: Annotated[tuple[str, ...], NoDecode] = Field(
        default=(),
        description="origins besides the service's own whose pages may open sockets and change things "
        "(https://studio.example), separated by commas",
    )
    max_body_bytes: int = Field(
        default=MIB, ge=1024, le=1024 * MIB, description="largest request body, bytes; a job of 1,000 levels has 60 KB"
    )
    max_table_bytes: int = Field(
        default=16 * MIB,
        ge=1024,
        le=64 * MIB,
        description="largest lens table file taken by POST /tables, bytes; a table of 1,000 levels has 2 MB",
    )
    queue_limit: int = Field(default=100, ge=1, le=100_000, description="most jobs that may wait, jobs")
    retry_after_s: int = Field(
        default=30, ge=1, le=3600, description="when a client refused for lack of room should ask again, seconds"
    )
    cpu_workers: int = Field(
        default_factory=default_cpu_workers, ge=1, le=256, description="threads for the numerics, threads"
    )
    event_batch: int = Field(default=200, ge=1, le=1000, description="most events read from the store at once, events")
    event_listeners: int = Field(default=200, ge=1, le=10_000, description="most event sockets at once, sockets")
    heartbeat_s: float = Field(
        default=15.0, gt=0, le=300, description="longest silence on an event socket, seconds; below usual proxies' 60"
    )
    send_timeout_s: float = Field(
        default=10.0,
        gt=0,
        le=300,
        description="longest wait for a client that does not read its event socket, seconds; then it is closed",
    )
    shutdown_timeout_s: int = Field(
        default=8, ge=1, le=300, description="longest wait for open requests when the service stops, seconds"
    )
    ready_timeout_s: float = Field(
        default=2.0, gt=0, le=60, description="longest wait for the database when asked whether it is ready, seconds"
    )
    min_free_disk_bytes: int = Field(
        default=200 * MIB, ge=0, description="free space under which the service says that it is not ready, bytes"
    )

    @field_validator("profiles", mode="before")
    @classmethod
    def _split_paths(cls, value: object) -> object:
        return tuple(part for part in value.split(os.pathsep) if part) if isinstance(value, str) else value

    @field_validator("allowed_hosts", "allowed_origins", mode="before")
    @classmethod
    def _split_commas(cls, value: object) -> object:
        return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value

    @field_validator("allowed_hosts")
    @classmethod
    def _host_names(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            if not HOST_NAME.fullmatch(name):
                raise ValueError(f"{name!r} is no host name; write names without scheme, port or *")
        return tuple(name.lower() for name in names)

    @field_validator("allowed_origins")
    @classmethod
    def _origins(cls, origins: tuple[str, ...]) -> tuple[str, ...]:
        for origin in origins:
            scheme, _, rest = origin.partition("://")
            if scheme not in ("http", "https") or not rest or any(sign in rest for sign in "/*@?# "):
                raise ValueError(f"{origin!r} is no origin; write scheme and host, as in https://studio.example:8443")
        return tuple(origin.lower() for origin in origins)


def reference_text() -> str:
    """``docs/reference/settings.md``: every setting with its default and what it does."""
    lines = [
        "# Settings",
        "",
        "Of the service (`lensmatch serve`), read once when it starts, from environment variables.",
        "What is given on the command line wins.",
        "",
        "| variable | default | what it is |",
        "| --- | --- | --- |",
    ]
    for name, field in Settings.model_fields.items():
        if field.default_factory is not None:
            default = "depends on the machine"
        elif isinstance(field.default, tuple):
            default = f"`{','.join(map(str, field.default))}`" if field.default else "none"
        else:
            default = f"`{field.default}`"
        lines.append(f"| `{PREFIX}{name.upper()}` | {default} | {field.description} |")
    return "\n".join(lines) + "\n"
