"""Stands before a real broker, and breaks one promise: each fault is a class of a few lines."""

from __future__ import annotations

import asyncio
import threading
from abc import ABC, abstractmethod
from contextlib import suppress
from types import TracebackType
from typing import Self

from tests.kit.mqtt_bytes import packet
from tests.sparing_broker import packet_of
from tests.support import free_port

CONNECT, PUBLISH, SUBSCRIBE, PINGRESP, DISCONNECT = 0x10, 0x30, 0x80, 0xD0, 0xE0
RETAIN, BRIDGE = 0x01, 0x80
_LEVEL = 6  # its place in the body of a CONNECT
_LATE_S = 3.0


class Fault:
    """What passes on one connection: a packet becomes those that go on. ``ends``: what the broker gets at a loss."""

    ends = b""
    late_s = 0.0  # after which the broker notices a loss

    def __init__(self) -> None:
        self.answers: list[bytes] = []  # to the client, at once

    def up(self, first: int, body: bytes) -> list[bytes]:
        return [packet(first, body)]

    def down(self, first: int, body: bytes) -> list[bytes]:
        return [packet(first, body)]


def kind(first: int) -> int:
    return first & 0xF0


class DropsWills(Fault):
    ends = packet(DISCONNECT, b"")


class LateWills(Fault):
    late_s = _LATE_S


class RetainsNothing(Fault):
    def up(self, first: int, body: bytes) -> list[bytes]:
        return super().up(first & ~RETAIN if kind(first) == PUBLISH else first, body)


class HidesRetained(Fault):
    """What is retained looks live."""

    def down(self, first: int, body: bytes) -> list[bytes]:
        return super().down(first & ~RETAIN if kind(first) == PUBLISH else first, body)


class Doubles(Fault):
    def down(self, first: int, body: bytes) -> list[bytes]:
        return super().down(first, body) * (2 if kind(first) == PUBLISH else 1)


class Floods(Fault):
    """Sends 30 MB after each subscription."""

    def up(self, first: int, body: bytes) -> list[bytes]:
        if kind(first) == SUBSCRIBE:
            self.answers += [packet(PUBLISH, b"\0\1x" + bytes(1_000_000))] * 30
        return super().up(first, body)


class Mute(Fault):
    """Answers no ping."""

    def down(self, first: int, body: bytes) -> list[bytes]:
        return [] if first == PINGRESP else super().down(first, body)


class EagerPongs(Fault):
    """Answers pings at once, before what waits."""

    def up(self, first: int, body: bytes) -> list[bytes]:
        if first != 0xC0:
            return super().up(first, body)
        self.answers.append(packet(PINGRESP, b""))
        return []


class _Connects(Fault, ABC):
    def up(self, first: int, body: bytes) -> list[bytes]:
        return super().up(first, self.changed(body) if first == CONNECT else body)

    @abstractmethod
    def changed(self, body: bytes) -> bytes:
        """The CONNECT that the broker sees."""


class SendsBack(_Connects):
    """Takes bridge mode and does not keep it; does not take MQTT 5."""

    def changed(self, body: bytes) -> bytes:
        return body[:_LEVEL] + bytes((body[_LEVEL] & ~BRIDGE if body[_LEVEL] != 5 else 9,)) + body[_LEVEL + 1 :]


class FaultyBroker:
    """A proxy on a loopback port of its own, until its ``with`` block ends."""

    def __init__(self, to: int, fault: type[Fault]) -> None:
        self.port, self._to, self._fault = free_port(), to, fault
        self._loop = asyncio.new_event_loop()
        self._loop.run_until_complete(asyncio.start_server(self._serve, "127.0.0.1", self.port))
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        tasks = asyncio.all_tasks(self._loop)
        for task in tasks:
            task.cancel()
        if tasks:
            self._loop.run_until_complete(asyncio.wait(tasks))
        self._loop.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        fault = self._fault()
        to_reader, to_writer = await asyncio.open_connection("127.0.0.1", self._to)
        back = asyncio.ensure_future(self._back(to_reader, writer, fault))
        with suppress(OSError, asyncio.IncompleteReadError):
            while True:
                first, _, body = await packet_of(reader)
                to_writer.writelines(fault.up(first, body))
                writer.writelines(fault.answers)
                fault.answers = []
        await asyncio.sleep(fault.late_s)
        with suppress(OSError):
            to_writer.write(fault.ends)
        to_writer.close()
        await back

    async def _back(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, fault: Fault) -> None:
        with suppress(OSError, asyncio.IncompleteReadError):
            while True:
                first, _, body = await packet_of(reader)
                writer.writelines(fault.down(first, body))
        writer.close()
