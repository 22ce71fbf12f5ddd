"""A TCP link that can fail the way networks do: go silent, be cut, come back."""

from __future__ import annotations

import select
import socket
import struct
import threading
import time
from contextlib import suppress
from types import TracebackType
from typing import Self

from tests.support import free_port

_STEP_S = 0.02  # how soon a change of mode is noticed
_RESET = struct.pack("ii", 1, 0)  # SO_LINGER that turns close() into a reset


class Link:
    """Listens on ``port`` and passes everything on to ``target``, a port of this machine.

    `hole` passes nothing more and closes nothing, as a radio link does that lost its signal: new connections are
    accepted by the kernel and hear nothing. `resume` ends that: what was held is passed on late, unless one end has
    given its connection up meanwhile; then the other end hears so. `cut` resets what is connected and refuses
    what comes, until `mend`. `drop` only resets what is connected now.
    """

    def __init__(self, target: int, *, delay_s: float = 0.0, piece: int = 65536) -> None:
        self.port = free_port()
        self.delay_s = delay_s  # added to every piece in either direction
        self.piece = piece  # bytes at most; small ones part what was sent together
        self._target = target
        self._lock = threading.Lock()
        self._pairs: list[_Pair] = []
        self._passing = threading.Event()
        self._passing.set()
        self._listener: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self.mend()

    def hole(self) -> None:
        self._passing.clear()

    def resume(self) -> None:
        with self._lock:
            for pair in self._pairs:
                pair.reset_if_given_up()
        self._passing.set()

    def cut(self) -> None:
        listener, self._listener = self._listener, None
        if listener is not None and self._thread is not None:
            listener.close()
            self._thread.join(5)
        self.drop()

    def mend(self) -> None:
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("127.0.0.1", self.port))
        listener.listen(64)
        listener.settimeout(_STEP_S)
        self._listener = listener
        self._thread = threading.Thread(target=self._accept, args=(listener,), daemon=True)
        self._thread.start()

    def drop(self) -> None:
        with self._lock:
            pairs, self._pairs = self._pairs, []
        for pair in pairs:
            pair.reset()
        for pair in pairs:
            pair.join()

    def stop(self) -> None:
        self.cut()
        self._passing.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.stop()

    def _accept(self, listener: socket.socket) -> None:
        while listener is self._listener:
            if not self._passing.is_set():
                time.sleep(_STEP_S)  # nobody answers in a hole
                continue
            with suppress(TimeoutError, OSError):
                near, _ = listener.accept()
                self._join_to_target(near)

    def _join_to_target(self, near: socket.socket) -> None:
        try:
            far = socket.create_connection(("127.0.0.1", self._target), 2)
        except OSError:
            near.close()
            return
        for end in (near, far):
            end.settimeout(None)
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with self._lock:
            self._pairs = [pair for pair in self._pairs if not pair.gone]
            self._pairs.append(_Pair(self, near, far))

    def wait_until_passing(self) -> bool:
        """True at once while the link works; False after a moment in a hole."""
        return self._passing.wait(_STEP_S)


class _Pair:
    """The two connections that make one connection through a link."""

    def __init__(self, link: Link, near: socket.socket, far: socket.socket) -> None:
        self._link, self._ends = link, (near, far)
        self.gone = False
        self._threads = [
            threading.Thread(target=self._carry, args=(source, sink), daemon=True)
            for source, sink in ((near, far), (far, near))
        ]
        for thread in self._threads:
            thread.start()

    def reset_if_given_up(self) -> None:
        poll = select.poll()
        for end in self._ends:
            if end.fileno() >= 0:
                poll.register(end, select.POLLRDHUP)
        if poll.poll(0):
            self.reset()

    def reset(self) -> None:
        self.gone = True
        for end in self._ends:
            with suppress(OSError):
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            end.close()

    def join(self) -> None:
        for thread in self._threads:
            thread.join(5)

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError, ValueError):  # an end was closed
            while not self.gone:
                if not self._link.wait_until_passing() or not select.select([source], [], [], _STEP_S)[0]:
                    continue
                data = source.recv(self._link.piece)
                if not data:
                    break
                time.sleep(self._link.delay_s)
                self._send(sink, data)
        self.reset()

    def _send(self, sink: socket.socket, data: bytes) -> None:
        while data and not self.gone:
            if self._link.wait_until_passing() and select.select([], [sink], [], _STEP_S)[1]:
                data = data[sink.send(data, socket.MSG_DONTWAIT) :]
