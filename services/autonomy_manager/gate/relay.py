"""Passes the bytes of one client to a connection of its own to the robot's broker, and back."""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl
from collections.abc import Callable

from pebble.services.autonomy_manager.gate.activity import Activity
from pebble.services.autonomy_manager.gate.answers import AnswerMerger
from pebble.services.autonomy_manager.gate.client_filter import ClientFilter, Output
from pebble.services.autonomy_manager.gate.packets import PacketError, connack, refusal
from pebble.transports.hosts import CONNECT_TIMEOUT_S, Address, addresses_of, described

CHUNK = 64 * 1024  # bytes per read; a receiver with more unsent bytes makes its sender wait
_CONNECT_S = 5.0  # for a client's CONNECT, and for reaching the broker
_CLOSE_S = 1.0  # for the last bytes to the other end
_UNAVAILABLE = 3  # CONNACK: server unavailable

log = logging.getLogger(__name__)

Stream = tuple[asyncio.StreamReader, asyncio.StreamWriter]
Broker = tuple[str, int, ssl.SSLContext | None]  # host, port; None: without TLS


class Relay:
    """One client of the gate. ``on_output(output, self)`` gets what its bytes result in, ``on_end(self)`` their end."""

    def __init__(
        self,
        client: Stream,
        packets: ClientFilter,
        on_output: Callable[[Output, Relay], None],
        on_end: Callable[[Relay], None],
        activity: Activity,
    ) -> None:
        self._reader, self._writer = client
        self._packets, self._on_output, self._on_end = packets, on_output, on_end
        self._answers, self._activity = AnswerMerger(), activity

    async def run(self, broker: Broker) -> None:
        """Log the client in, and pass its packets until one end closes or sends something invalid."""
        try:
            output = await self._log_in()
            if self._packets.connected:
                await self._pass(output, *await self._open(broker, output))
        except (OSError, TimeoutError, PacketError) as error:
            log.debug("a script's connection ended: %r", error)
        finally:
            await _close(self._writer)

    async def _log_in(self) -> Output:
        output = Output()
        async with asyncio.timeout(_CONNECT_S):
            while not self._packets.connected and output.refusal is None:
                data = await self._reader.read(CHUNK)
                if not data:
                    break
                output = self._packets.feed(data)
        if not self._packets.connected:
            self._writer.write(output.answers)
            self._on_output(output, self)
        return output

    async def _open(self, broker: Broker, first: Output) -> tuple[Stream, bytes]:
        """A connection and what has come by it: the first address that accepts the client, else the last one."""
        host, port, _context = broker
        failures: dict[str, str] = {}
        why = f"{host}:{port}"
        try:
            async with asyncio.timeout(_CONNECT_S):
                *others, last = await asyncio.to_thread(addresses_of, host, port)
            for address in others:
                try:
                    return await _accepted(broker, address, first)
                except (OSError, TimeoutError) as error:
                    failures[address.text] = str(error) or "no answer"
            why = f"{host}:{port} at {last.text}" if others else why
            async with asyncio.timeout(_CONNECT_S):
                return await _dial(broker, last), b""
        except (OSError, TimeoutError) as error:
            before = f"; {described(failures)}" if failures else ""
            log.warning("a script cannot reach the robot's broker %s: %s%s", why, error or "no answer", before)
            self._writer.write(connack(_UNAVAILABLE))
            raise

    async def _pass(self, first: Output, broker: Stream, received: bytes) -> None:
        down = self._down(broker[0], received)
        tasks = [asyncio.create_task(self._up(first, broker[1])), asyncio.create_task(down)]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self._on_end(self)
            await _close(broker[1])

    async def _up(self, output: Output, broker: asyncio.StreamWriter) -> None:
        while True:
            self._on_output(output, self)
            if output.upstream:
                broker.write(output.upstream)
                await broker.drain()
            if output.answers:
                self._writer.write(self._answers.answer(output.answers))
                await self._writer.drain()
            data = b"" if output.refusal is not None else await self._reader.read(CHUNK)
            if not data:
                return
            output = self._packets.feed(data)

    async def _down(self, broker: asyncio.StreamReader, data: bytes) -> None:
        while data := data or await broker.read(CHUNK):
            before = self._answers.messages
            self._writer.write(self._answers.feed(data))
            if self._answers.messages > before:
                self._activity.message()
            await self._writer.drain()
            data = b""


async def _dial(broker: Broker, address: Address) -> Stream:
    host, _port, context = broker
    sock = socket.socket(address.family, socket.SOCK_STREAM)
    try:
        sock.setblocking(False)
        await asyncio.get_running_loop().sock_connect(sock, address.place)
        name = None if context is None else host
        return await asyncio.open_connection(sock=sock, ssl=context, server_hostname=name, limit=CHUNK)
    except BaseException:
        sock.close()
        raise


async def _accepted(broker: Broker, address: Address, first: Output) -> tuple[Stream, bytes]:
    """Log in there with what the client has sent, its CONNECT at least. Raises OSError, TimeoutError."""
    async with asyncio.timeout(2 * CONNECT_TIMEOUT_S):  # TCP and TLS
        reader, writer = await _dial(broker, address)
    received = b""
    try:
        async with asyncio.timeout(CONNECT_TIMEOUT_S):
            writer.write(first.upstream)
            while (refused := refusal(received)) is None:
                if not (data := await reader.read(CHUNK)):
                    raise ConnectionError("it hung up")
                received += data
        if refused:
            raise ConnectionError(f"it refused the connection: {refused}")
    except BaseException:
        writer.transport.abort()
        raise
    first.upstream = bytearray()
    return (reader, writer), received


async def _close(writer: asyncio.StreamWriter) -> None:
    """Send what waits, for a moment, then close."""
    writer.close()
    try:
        async with asyncio.timeout(_CLOSE_S):
            await writer.wait_closed()
    except (OSError, TimeoutError):
        writer.transport.abort()
