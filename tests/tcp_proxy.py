"""TCP proxies on loopback that fail as networks do: going silent, resetting connections, or limiting the rate."""

from __future__ import annotations

import os
import select
import socket
import struct
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from tests.support import WAIT_S, free_port

_STEP_S = 0.02  # how soon a change of mode is noticed
_RESET = struct.pack("ii", 1, 0)  # SO_LINGER that turns close() into a reset
_SLOW_PIECE = 512  # bytes that go at once: the connections take turns
_SEGMENT = 1400  # bytes; the loopback device has packets of 64 KB, which no radio has
_BUFFER = 4096  # bytes that the far end's kernel confirms before they have gone through


class TcpProxy:
    """A proxy that listens on ``port`` and passes everything on to ``target``, a port of this machine.

    `blackhole` stops passing data and closes nothing, as a radio link does that loses its signal: the kernel accepts
    new connections, and they receive nothing. `resume` ends that: held data is passed on late, or the connection is
    reset if one end has closed it meanwhile. `cut` resets all connections and refuses new ones until `mend`. `drop`
    only resets the present ones.
    """

    def __init__(self, target: int, *, delay_s: float = 0.0, piece: int = 65536) -> None:
        self.port = free_port()
        self.delay_s = delay_s  # added to every piece in either direction
        self.piece = piece  # bytes at most; small ones split what was sent together
        self._target = target
        self._lock = threading.Lock()
        self._pairs: list[_Pair] = []
        self._passing = threading.Event()
        self._passing.set()
        self._listener: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self.mend()

    judges_answers = False  # `passes` is asked for what the target sends, too

    def blackhole(self) -> None:
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
            self._thread.join(WAIT_S)
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

    def lead_to(self, target: int) -> None:
        """Lead new connections to another port; those to the former port are reset."""
        self.drop(target)

    def drop(self, target: int | None = None) -> None:
        with self._lock:
            pairs, self._pairs = self._pairs, []
            self._target = target or self._target
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
                time.sleep(_STEP_S)  # a black hole accepts nothing
                continue
            with suppress(TimeoutError, OSError):
                near, _ = listener.accept()
                self._join_to_target(near)

    def _join_to_target(self, near: socket.socket) -> None:
        target = self._target
        far = socket.socket()
        try:
            self.connect(far, target)
        except OSError:
            near.close()
            far.close()
            return
        for end in (near, far):
            end.settimeout(None)
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with self._lock:
            self._pairs = [pair for pair in self._pairs if not pair.gone]
            if target == self._target:
                self._pairs.append(_Pair(self, near, far))
                return
        for end in (near, far):  # it leads elsewhere by now
            end.close()

    def connect(self, far: socket.socket, target: int) -> None:
        far.settimeout(2)
        far.connect(("127.0.0.1", target))

    def hold(self, _size: int, *, answers: bool) -> None:
        """Hold up a piece of data; ``answers``: it is what the target sends."""
        time.sleep(self.delay_s)

    def passes(self, _data: bytes) -> bool:
        """True if a client's data is passed on; otherwise its connection is reset."""
        return True

    def wait_until_passing(self) -> bool:
        """Return True at once while data passes, False after a moment in a black hole."""
        return self._passing.wait(_STEP_S)


class PrefixProxy(TcpProxy):
    """A reverse proxy that shows a web server below ``prefix``, which ends with a slash and is removed.

    ``outside``: paths elsewhere that were requested, and answered with 404.
    """

    def __init__(self, target: int, prefix: str) -> None:
        self.prefix, self.outside = prefix.encode(), list[str]()
        super().__init__(target)

    def _join_to_target(self, near: socket.socket) -> None:
        threading.Thread(target=self._ask, args=(near,), daemon=True).start()  # browsers open some before they ask

    def _ask(self, near: socket.socket) -> None:
        asked = b""
        with suppress(OSError):
            while b"\r\n\r\n" not in asked:
                if not (data := near.recv(65536)):
                    return near.close()
                asked += data
            method, path, rest = asked.split(b" ", 2)
            if not path.startswith(self.prefix):
                self.outside.append(path.decode())
                near.sendall(b"HTTP/1.1 404 \r\ncontent-length: 0\r\nconnection: close\r\n\r\n")
                return near.close()
            rest = rest.replace(b"Connection: keep-alive", b"Connection: close")  # one request on each
            far = socket.create_connection(("127.0.0.1", self._target), 2)
            far.settimeout(None)
            far.sendall(b" ".join((method, b"/" + path.removeprefix(self.prefix), rest)))
            threading.Thread(target=_carry, args=(near, far), daemon=True).start()
            _carry(far, near)
        return near.close()


def _carry(source: socket.socket, sink: socket.socket) -> None:
    """Copy data until its end, and pass on the end."""
    with suppress(OSError):
        while data := source.recv(65536):
            sink.sendall(data)
        sink.shutdown(socket.SHUT_WR)


class BridgelessProxy(TcpProxy):
    """A proxy that answers bridge mode with ``answer`` and hangs up, as RabbitMQ does, while ``bridgeless`` is set."""

    bridgeless, answer = True, b""
    connections = 0

    def _join_to_target(self, near: socket.socket) -> None:
        self.connections += 1
        near.settimeout(5)
        connect = near.recv(16, socket.MSG_PEEK)
        if self.bridgeless and connect.partition(b"MQTT")[2][0] & 0x80:  # the protocol level
            near.recv(4096)
            near.sendall(self.answer)
            near.close()
        else:
            super()._join_to_target(near)


class ForbiddingProxy(TcpProxy):
    """A proxy that makes any broker hang up on each PUBLISH to a `forbidden` topic, as aedes and hosted ones do."""

    def __init__(self, target: int) -> None:
        self.forbidden: set[str] = set()
        super().__init__(target)

    def passes(self, data: bytes) -> bool:
        """True if ``data``, which a client has sent together, has no forbidden PUBLISH."""
        if not any(b"\0" + bytes((len(topic),)) + topic.encode() in data for topic in self.forbidden):
            return True
        return 0x30 not in {data[at] & 0xF0 for at in _packets(data)}  # a SUBSCRIBE


class Hole(TcpProxy):
    """A way on which large packets are lost, unless the client's segments are small."""

    judges_answers, limit = True, 1400

    def passes(self, data: bytes) -> bool:
        if len(data) < self.limit or self.segments() < 1300:
            return True
        time.sleep(0.6)
        return False

    def segments(self) -> int:
        """Return the largest segment of this process's connections to it."""
        sizes = [0]
        for link in list(Path("/proc/self/fd").iterdir()):
            with suppress(OSError, IndexError):
                if not str(link.readlink()).startswith("socket:"):
                    continue
                with socket.socket(fileno=os.dup(int(link.name))) as copy:
                    if copy.getpeername()[1] == self.port:
                        sizes.append(copy.getsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG))
        return max(sizes)


def _packets(data: bytes) -> list[int]:
    """Return where each packet in ``data`` begins: whole ones that are shorter than 16 KB."""
    found, at = [], 0
    while at + 2 < len(data):
        found.append(at)
        size, head = (data[at + 1], 2) if data[at + 1] < 128 else (data[at + 1] & 127 | data[at + 2] << 7, 3)
        at += head + size
    return found


class _Pair:
    """The two connections that make one connection through a proxy."""

    def __init__(self, proxy: TcpProxy, near: socket.socket, far: socket.socket) -> None:
        self._proxy, self._ends = proxy, (near, far)
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
            thread.join(WAIT_S)

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError, ValueError):  # an end was closed
            while not self.gone:
                if not self._proxy.wait_until_passing() or not select.select([source], [], [], _STEP_S)[0]:
                    continue
                data = source.recv(self._proxy.piece)
                answers = source is self._ends[1]
                judged = not answers or self._proxy.judges_answers
                if not data or (judged and not self._proxy.passes(data)):
                    break
                self._proxy.hold(len(data), answers=answers)
                self._send(sink, data)
        self.reset()

    def _send(self, sink: socket.socket, data: bytes) -> None:
        while data and not self.gone:
            if self._proxy.wait_until_passing() and select.select([], [sink], [], _STEP_S)[1]:
                data = data[sink.send(data, socket.MSG_DONTWAIT) :]


class SlowTcpProxy(TcpProxy):
    """A proxy that passes at most ``kbits`` per second of what ``target`` sends, and any number to it."""

    def __init__(self, target: int, kbits: float) -> None:
        self.kbits = kbits
        self.passed = 0  # bytes that were slow
        self._turn = threading.Lock()
        self._free_at = 0.0
        super().__init__(target, piece=_SLOW_PIECE)

    def connect(self, far: socket.socket, target: int) -> None:
        far.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        far.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, _SEGMENT)
        super().connect(far, target)

    def hold(self, size: int, *, answers: bool) -> None:
        """Wait until the line has sent ``size`` bytes of the target; callers take turns in the order of their calls."""
        if not answers:
            return
        with self._turn:
            now = time.monotonic()
            self._free_at = max(self._free_at, now) + size * 8 / (self.kbits * 1000)
            self.passed += size
            wait = self._free_at - now
        time.sleep(wait)
