"""The R3 text socket's client: connections, the render engine port, and pictures by snapshot.

One :class:`R3Connection` is one TCP connection: open, busy or closed, and never reopened. A timeout, a cancellation
or a wrong answer in the middle of an exchange closes it, because the late reply would pass for the next command's.
:class:`R3Client` opens a new one for the next command.
"""

from __future__ import annotations

import asyncio
import logging
import time
from concurrent.futures import Executor
from enum import StrEnum
from typing import Any, Self, TypeVar

from engine_adapters.errors import AdapterError, ProtocolError, Refused, TimedOut, Unreachable, UnsafeText
from engine_adapters.ports import EncodedFrame, EngineState, LensValues, ReadBack, Shown, TrackedCamera
from engine_adapters.profile import R3Settings, StudioProfile
from engine_adapters.r3 import commands
from engine_adapters.r3.mapping import EngineMapping, same_value
from engine_adapters.r3.protocol import Command, Exchange, TimeoutClass

T = TypeVar("T")

CLOSE_TIMEOUT_S = 1.0
"""Longest wait for a closing socket: nothing is sent any more, so the operating system needs no round trip."""

_MIB = 1024 * 1024

logger = logging.getLogger(__name__)


class ConnectionState(StrEnum):
    """What a connection can do."""

    OPEN = "open"
    BUSY = "busy"
    """A command's reply is awaited."""
    CLOSED = "closed"
    """For good."""


class R3Connection(asyncio.Protocol):
    """One TCP connection to the engine; one exchange at a time."""

    def __init__(self, settings: R3Settings) -> None:
        self.where = f"R3 at {settings.host}:{settings.port}"
        self.state = ConnectionState.OPEN
        self.fault: AdapterError | None = None
        """Why the connection ended, where it was not simply closed."""
        self._settings = settings
        self._transport: asyncio.Transport | None = None
        self._exchange: Exchange[Any] | None = None
        self._reply: asyncio.Future[None] | None = None
        self._lost: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    @classmethod
    async def open(cls, settings: R3Settings) -> Self:
        """Connect within ``connect_timeout_s``. Raises ``Unreachable`` or ``TimedOut``."""
        where = f"R3 at {settings.host}:{settings.port}"
        try:
            async with asyncio.timeout(settings.connect_timeout_s):
                _, connection = await asyncio.get_running_loop().create_connection(
                    lambda: cls(settings), settings.host, settings.port
                )
        except TimeoutError as error:
            raise TimedOut("the connection", settings.connect_timeout_s, where=where) from error
        except (OSError, UnicodeError) as error:
            raise Unreachable(
                f"no connection ({error}); start R3, or set r3.host and r3.port of the studio profile", where=where
            ) from error
        return connection

    async def exchange(self, command: Command[T], *, executor: Executor | None = None) -> T:
        """Send one command and return its typed answer.

        Raises ``Refused`` (the connection stays open), ``TimedOut``, ``Unreachable``, ``ProtocolError``, ``BadPicture``
        (the connection is closed), ``UnsafeText`` (nothing was sent). A cancellation closes the connection.
        """
        data = command.encode(
            encoding=self._settings.encoding, line_ending="\r\n" if self._settings.line_ending == "crlf" else "\n"
        )
        if self.state is ConnectionState.BUSY:
            raise ProtocolError(f"{command.name} while another answer is awaited", where=self.where)
        if self.state is ConnectionState.CLOSED or self._transport is None:
            raise self.fault or Unreachable("the connection is closed", where=self.where)
        exchange = Exchange(command, encoding=self._settings.encoding, limit_bytes=self._limit_bytes(command))
        bound_s = self._bound_s(command.timeout_class)
        self._exchange = exchange
        self._reply = asyncio.get_running_loop().create_future()
        self.state = ConnectionState.BUSY
        finished = False
        try:
            self._transport.write(data)
            try:
                async with asyncio.timeout(bound_s):
                    await self._reply
            except TimeoutError as error:
                raise self._timed_out(exchange, bound_s) from error
            if command.timeout_class is TimeoutClass.PICTURE:
                # Megabytes of base64 take milliseconds, which the event loop does not have.
                answer = await asyncio.get_running_loop().run_in_executor(executor, exchange.result)
            else:
                answer = exchange.result()
            finished = True
            return answer
        except Refused as error:
            finished = exchange.done
            raise Refused(error.answer, where=self.where, command=error.command) from error
        except ProtocolError as error:
            if error.where:
                raise
            raise ProtocolError(str(error), where=self.where) from error
        finally:
            self._exchange = None
            self._reply = None
            if self.state is ConnectionState.BUSY:
                if finished:
                    self.state = ConnectionState.OPEN
                else:
                    self.abort()

    def abort(self) -> None:
        """Drop the connection at once."""
        self.state = ConnectionState.CLOSED
        if self._transport is not None:
            self._transport.abort()

    async def close(self) -> None:
        """Close the connection; an exchange that is under way ends with ``Unreachable``."""
        self.abort()
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT_S):
                await asyncio.shield(self._lost)
        except TimeoutError:
            logger.warning("%s: the socket did not close within %g s", self.where, CLOSE_TIMEOUT_S)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Called by asyncio."""
        assert isinstance(transport, asyncio.Transport)  # what create_connection makes
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        """Called by asyncio: bytes of the awaited reply, or bytes that nobody asked for."""
        if self.state is ConnectionState.CLOSED:
            return
        if self._exchange is None or self._reply is None or self._exchange.done:
            self._fail(ProtocolError(f"{len(data)} bytes that no command asked for: {data[:40]!r}", where=self.where))
            return
        try:
            done = self._exchange.feed(data)
        except ProtocolError as error:
            self._fail(ProtocolError(str(error), where=self.where))
            return
        if done and not self._reply.done():
            self._reply.set_result(None)

    def connection_lost(self, exc: Exception | None) -> None:
        """Called by asyncio: the socket is gone."""
        if not self._lost.done():
            self._lost.set_result(None)
        told = f" ({exc})" if exc else ""
        waiting = f" in the middle of {self._exchange.command.name}" if self._exchange is not None else ""
        self._fail(Unreachable(f"the connection was lost{waiting}{told}", where=self.where))

    def _fail(self, error: AdapterError) -> None:
        if self.fault is None and (self.state is not ConnectionState.CLOSED or self._reply is not None):
            self.fault = error
        self.abort()
        # A whole reply that was read before the connection ended is still the command's.
        if self._reply is not None and not self._reply.done():
            self._reply.set_exception(error)

    def _timed_out(self, exchange: Exchange[T], bound_s: float) -> AdapterError:
        # Fewer lines than asked, with an error among them: the engine refused the line as a whole.
        for line in exchange.lines:
            if refused := commands.refusal(line, command=exchange.command.name):
                return refused
        return TimedOut(exchange.command.name, bound_s, where=self.where)

    def _bound_s(self, timeout_class: TimeoutClass) -> float:
        match timeout_class:
            case TimeoutClass.COMMAND:
                return self._settings.command_timeout_s
            case TimeoutClass.SNAPSHOT:
                return self._settings.snapshot_timeout_s
            case TimeoutClass.PICTURE:
                return self._settings.picture_timeout_s

    def _limit_bytes(self, command: Command[T]) -> int:
        picture = command.timeout_class is TimeoutClass.PICTURE
        return int((self._settings.max_picture_mib if picture else self._settings.max_reply_mib) * _MIB)


class R3Client:
    """Commands to one engine, one after another, on a connection that is renewed after a loss."""

    def __init__(self, settings: R3Settings, *, executor: Executor | None = None) -> None:
        self.where = f"R3 at {settings.host}:{settings.port}"
        self._settings = settings
        self._executor = executor
        self._lock = asyncio.Lock()
        self._connection: R3Connection | None = None
        self._closed = False
        self._lost = False

    @property
    def connected(self) -> bool:
        """Whether a connection is open now; the next command opens one where there is none."""
        return self._connection is not None and self._connection.state is not ConnectionState.CLOSED

    async def run(self, command: Command[T]) -> T:
        """Send a command once and return its answer. Raises what :meth:`R3Connection.exchange` raises.

        An engine that ended the connection between two commands is met with a new one; bytes that nobody asked for
        raise ``ProtocolError`` once, and nothing is sent.
        """
        async with self._lock:
            try:
                connection = await self._usable()
                try:
                    answer = await connection.exchange(command, executor=self._executor)
                except BaseException:
                    if connection.state is ConnectionState.CLOSED:
                        self._connection = None  # its fault was told with this command
                    raise
            except (Unreachable, TimedOut) as error:
                if not self._lost and not self._closed:
                    self._lost = True
                    logger.warning("%s", error)
                raise
        if self._lost:
            self._lost = False
            logger.info("%s: answers again", self.where)
        return answer

    async def close(self) -> None:
        """Close the connection; a command under way ends with ``Unreachable``. Safe to call twice."""
        self._closed = True
        if self._connection is not None:
            await self._connection.close()

    async def _usable(self) -> R3Connection:
        if self._closed:
            raise Unreachable("this client was closed", where=self.where)
        last = self._connection
        if last is not None and last.state is ConnectionState.CLOSED:
            self._connection = None
            if isinstance(last.fault, ProtocolError):
                raise last.fault
        if self._connection is None:
            self._connection = await R3Connection.open(self._settings)
        return self._connection


class R3Engine:
    """The render engine port (:class:`engine_adapters.ports.RenderEngine`) on an R3 text socket."""

    def __init__(self, client: R3Client, mapping: EngineMapping) -> None:
        self.client = client
        self._mapping = mapping
        self._settings = mapping.r3

    @classmethod
    def from_profile(cls, profile: StudioProfile, *, executor: Executor | None = None) -> Self:
        """An engine with a client of its own. Connects with the first command."""
        return cls(R3Client(profile.r3, executor=executor), EngineMapping.from_profile(profile))

    async def read_state(self) -> EngineState:
        """Lens and switches as found. Raises ``ProtocolError`` for a value that could not be put back."""
        names = self._mapping.state_exports
        state = EngineState(exports=tuple([(name, await self._get(name)) for name in names]))
        try:
            commands.multi_export(self._settings.scene, state.exports)
        except UnsafeText as error:
            raise ProtocolError(f"a value of the engine could not be put back: {error}") from error
        return state

    async def restore(self, state: EngineState) -> None:
        """Put back what :meth:`read_state` gave."""
        await self._set(state.exports)

    async def apply(self, values: LensValues) -> None:
        """Set the lens in one MultiExport. Raises ``UnsafeText`` for a lens that cannot be sent."""
        await self._set(self._mapping.lens_to_engine(values))

    async def read_lens(self) -> LensValues:
        """The lens as the engine gives it back."""
        return self._mapping.lens_from_engine({name: await self._get(name) for name in self._mapping.lens_exports})

    async def read_back(self, values: LensValues) -> tuple[ReadBack, ...]:
        """Each export of the lens, as it was to be set and as the engine gives it back. Sets nothing.

        Raises ``UnsafeText`` for a lens that cannot be sent.
        """
        held = [(name, asked, await self._get(name)) for name, asked in self._mapping.lens_to_engine(values)]
        return tuple(ReadBack(name, asked, got, same_value(asked, got)) for name, asked, got in held)

    async def show(self, shown: Shown) -> None:
        """Switch background and object in one MultiExport."""
        await self._set(self._mapping.shown_to_engine(shown))

    async def tracking(self) -> TrackedCamera:
        """The current packet of the profile's tracking camera."""
        packet = await self.client.run(commands.get_tracking(self._settings.tracking_camera))
        return self._mapping.tracked_camera(packet)

    async def close(self) -> None:
        """Close the connection. Safe to call twice."""
        await self.client.close()

    async def _get(self, name: str) -> str:
        return await self.client.run(
            commands.get_value(self._settings.scene, name, reply=self._settings.getvalue_reply)
        )

    async def _set(self, values: tuple[tuple[str, str], ...]) -> None:
        if self._settings.ordered_replies:
            await self.client.run(commands.multi_export(self._settings.scene, values))
            return
        for name, value in values:
            await self.client.run(commands.set_value(self._settings.scene, name, value))


class R3Snapshots:
    """Pictures by way of the engine's disk (takeSnapshot, getSnapshot): the study's slow way, about 0.3 s each."""

    def __init__(self, client: R3Client, name: str) -> None:
        self._client = client
        self._name = name
        # A second snapshot would write over the first one's file before it is got.
        self._one_at_a_time = asyncio.Lock()

    @classmethod
    def from_profile(cls, profile: StudioProfile, *, executor: Executor | None = None) -> Self:
        """A source with a connection of its own, so that a picture does not hold up commands."""
        return cls(R3Client(profile.r3, executor=executor), profile.r3.snapshot_name)

    async def fetch(self) -> EncodedFrame:
        """Take a snapshot and get it."""
        async with self._one_at_a_time:
            requested_at_s = time.monotonic()
            await self._client.run(commands.take_snapshot(self._name))
            data = await self._client.run(commands.get_snapshot(self._name))
        source = f"{self._client.where} snapshot {self._name}"
        return EncodedFrame(data, requested_at_s, time.monotonic(), source)

    async def close(self) -> None:
        """Close the connection. Safe to call twice."""
        await self._client.close()
