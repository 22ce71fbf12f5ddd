"""A proxy of a real broker that sends retained messages for exact names only, or nothing after a long packet."""

from __future__ import annotations

import asyncio
import threading
from contextlib import suppress
from socket import IPPROTO_TCP, TCP_MAXSEG

from tests.support import free_port

_CONNECT, _PUBLISH, _SUBSCRIBE = 0x10, 0x30, 0x82
_NO_BRIDGE_MODE = b"\x20\x02\x00\x01"


class SparingBroker:
    """The proxy. ``by_name``: retained messages are sent for exact names, not for wildcards.

    ``longest``: bytes of a packet; a longer one, and what comes after it on its connection, never arrives. ``segment``:
    bytes of TCP that the newest client takes at once.
    """

    def __init__(self, to: int, *, by_name: bool = False, longest: int = 1 << 28) -> None:
        self.port, self._to, self._by_name = free_port(), to, by_name
        self._longest, self.stalled, self.segment = longest, 0, 0
        self._runner = asyncio.Runner(loop_factory=asyncio.new_event_loop)
        self._loop = self._runner.get_loop()
        self._loop.run_until_complete(asyncio.start_server(self._serve, "127.0.0.1", self.port))
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._runner.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        asked: list[bytes] = []
        self.segment = writer.get_extra_info("socket").getsockopt(IPPROTO_TCP, TCP_MAXSEG)
        with suppress(OSError, asyncio.IncompleteReadError):
            to_reader, to_writer = await asyncio.open_connection("127.0.0.1", self._to)
            back = asyncio.ensure_future(self._back(to_reader, writer, asked))
            with suppress(OSError, asyncio.IncompleteReadError):
                while True:
                    first, packet, body = await packet_of(reader)
                    if first == _CONNECT and body[6] & 0x80:
                        writer.write(_NO_BRIDGE_MODE)
                        break
                    if first == _SUBSCRIBE:
                        asked.append(body)
                    to_writer.write(packet)
            to_writer.close()
            await back
        writer.close()

    async def _back(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, asked: list[bytes]) -> None:
        with suppress(OSError, asyncio.IncompleteReadError):
            while True:
                first, packet, body = await packet_of(reader)
                if len(packet) > self._longest:
                    self.stalled += 1
                    await reader.read(-1)
                named = any(body[: 2 + int.from_bytes(body[:2], "big")] in one for one in asked)
                if named or not self._by_name or first & 0xF1 != _PUBLISH | 1:
                    writer.write(packet)


async def packet_of(reader: asyncio.StreamReader) -> tuple[int, bytes, bytes]:
    """Return a packet's first byte, the whole packet, and what follows its length."""
    head, size, shift = await reader.readexactly(2), 0, 0
    while head[-1] > 127:
        size, shift = size | (head[-1] & 127) << shift, shift + 7
        head += await reader.readexactly(1)
    body = await reader.readexactly(size | head[-1] << shift)
    return head[0], head + body, body
