"""``lensmatch serve``: the service."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer
import uvicorn

from app.api.context import AppContext
from app.bootstrap import load_engines, running_service, utc_now
from app.cli.configuration import build_settings
from app.cli.console import WorkFailed, print_json, reported_errors, results
from app.main import create_app, server_config
from app.settings import Settings

_BACKLOG = 2048
_LOG_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"


class _Server(uvicorn.Server):
    """Says when it listens, and leaves signals to the command, because jobs end after it."""

    def __init__(self, config: uvicorn.Config, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            self._ready()

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


def serve(
    host: Annotated[str | None, typer.Option(help="address to listen on [default: 127.0.0.1]")] = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="TCP port; 0: any free one [default: 8000]")
    ] = None,
    database: Annotated[
        Path | None, typer.Option(help="SQLite file with jobs and lens tables; made if it is not there")
    ] = None,
    profile: Annotated[
        list[Path] | None,
        typer.Option(help="studio profile of an engine; once for each, the first is the engine called default"),
    ] = None,
    allow_host: Annotated[
        list[str] | None, typer.Option(help="further name under which the service may be called, without port")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the address as one JSON document")] = False,
) -> None:
    """Run the service: jobs, lens tables and live events over HTTP and WebSocket, until Ctrl-C.

    What is not given comes from the environment (LENSMATCH_PORT, LENSMATCH_DATABASE ...). Stopped, it lets running
    jobs give their engines back and keeps every level that is finished.
    """
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format=_LOG_FORMAT)
    logging.getLogger("uvicorn").setLevel(logging.WARNING)
    for chatty in ("httpx", "httpcore", "alembic"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    with reported_errors(as_json):
        settings = build_settings(host=host, port=port, database=database, profiles=tuple(profile) if profile else None)
        if allow_host:
            hosts = (*settings.allowed_hosts, *allow_host)
            settings = build_settings(**settings.model_dump() | {"allowed_hosts": hosts})
        asyncio.run(_serve(settings, as_json))


async def _serve(settings: Settings, as_json: bool) -> None:
    engines = load_engines(settings.profiles)
    listener = _listen(settings.host, settings.port)
    with contextlib.closing(listener):
        url = _url(listener)

        def ready() -> None:
            if as_json:
                print_json({"url": url, "pid": os.getpid(), "database": str(settings.database)})
            else:
                results.print(f"Lensmatch listens on {url} (Ctrl-C stops it)")
                results.file.flush()

        async with running_service(settings, engines) as service:
            context = AppContext(settings, service.repository, service.runner, service.broker, utc_now)
            server = _Server(server_config(create_app(context), settings), ready)
            with _stopped_by_signals(server):
                await server.serve(sockets=[listener])


def _listen(host: str, port: int) -> socket.socket:
    """The listening socket, bound before anything else is opened. Raises WorkFailed."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except (OSError, UnicodeError) as error:
        raise WorkFailed(f"{host}: is no address of this machine; give another --host") from error
    listener = socket.socket(family, kind, protocol)
    try:
        if os.name == "posix":  # on Windows this would let two services share the port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(_BACKLOG)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        reason = error.strerror or str(error)
        raise WorkFailed(
            f"{host}:{port}: cannot listen ({reason}); is another program using the port? "
            "Give another --port, or 0 for a free one"
        ) from error
    return listener


def _url(listener: socket.socket) -> str:
    host, port = listener.getsockname()[:2]
    if host in ("0.0.0.0", "::"):
        host = "127.0.0.1"
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


@contextlib.contextmanager
def _stopped_by_signals(server: _Server) -> Iterator[None]:
    """SIGINT and SIGTERM (Ctrl-Break on Windows) stop the server; jobs and store are closed after it."""

    def stop(number: int, frame: FrameType | None) -> None:
        server.handle_exit(number, frame)

    numbers = [signal.SIGINT, signal.SIGTERM]
    if sys.platform == "win32":
        numbers.append(signal.SIGBREAK)
    before: dict[signal.Signals, Any] = {number: signal.signal(number, stop) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
