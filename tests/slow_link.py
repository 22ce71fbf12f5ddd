"""A TCP link of limited rate: what all connections send through it together, as through a modem."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import suppress
from types import TracebackType
from typing import Self

from tests.support import free_port

_PIECE = 512  # bytes that go at once: the connections take turns
_SEGMENT = 1400  # bytes; the loopback device has packets of 64 KB, which no radio has
_BUFFER = 4096  # bytes that the far end's kernel confirms before they have gone through


class SlowLink:
    """Listens on ``port``, passes on to ``target``: ``kbits`` per second at most there, without a limit back."""

    def __init__(self, target: int, kbits: float) -> None:
        self.port, self.kbits = free_port(), kbits
        self.passed = 0  # bytes to the target
        self._target = target
        self._turn = threading.Lock()
        self._free_at = 0.0
        self._sockets: list[socket.socket] = []
        self._listener = socket.socket()
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        self._listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, _SEGMENT)
        self._listener.bind(("127.0.0.1", self.port))
        self._listener.listen(16)
        threading.Thread(target=self._accept, daemon=True).start()

    def stop(self) -> None:
        for end in (self._listener, *self._sockets):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.stop()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(("127.0.0.1", self._target), 2)
                far.settimeout(None)
                self._sockets += [near, far]
                for source, sink, slow in ((near, far, True), (far, near, False)):
                    sink.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    threading.Thread(target=self._carry, args=(source, sink, slow), daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket, slow: bool) -> None:
        with suppress(OSError):
            while data := source.recv(_PIECE if slow else 65536):
                if slow:
                    self._wait(len(data))
                sink.sendall(data)
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def _wait(self, size: int) -> None:
        """Until so many bytes have gone, in the order in which they asked."""
        with self._turn:
            now = time.monotonic()
            self._free_at = max(self._free_at, now) + size * 8 / (self.kbits * 1000)
            self.passed += size
            wait = self._free_at - now
        time.sleep(wait)
