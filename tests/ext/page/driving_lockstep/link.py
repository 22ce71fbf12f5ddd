"""The network between pages and the server: TCP connections over a wire that delays, stalls and breaks."""

from __future__ import annotations

from collections.abc import Callable

from tests.ext.page.driving_lockstep.pages import Pages
from tests.ext.page.driving_lockstep.web_server import ServerSocket, WebServer

LOST = 1006  # how a page's socket ends without a closing handshake
NOTICED_S = 6.0  # after so long the server notices that a page no longer answers


class Pipe:
    """One direction of a wire. What waits while it is stalled is delivered when it is not, in order."""

    def __init__(self, scheduler: object, delay: float) -> None:
        self._scheduler = scheduler
        self.delay = delay
        self.stalled = False
        self.stalled_until = 0.0
        self._waiting: list[Callable[[], None]] = []
        self._last = 0.0

    def send(self, job: Callable[[], None]) -> None:
        if self.stalled:
            self._waiting.append(job)
        else:
            self._last = max(self._last, self._scheduler.now + self.delay)  # type: ignore[attr-defined]
            self._scheduler.at(self._last, job)  # type: ignore[attr-defined]

    @property
    def wait(self) -> float:
        """How long a message that is sent now travels."""
        now = self._scheduler.now  # type: ignore[attr-defined]
        stalled_s = self.stalled_until - now if self.stalled else 0.0
        return max(self._last - now, stalled_s + self.delay)

    def stall(self, until: float) -> None:
        self.stalled_until = min(self.stalled_until, until) if self.stalled else until
        self.stalled = True

    def release(self) -> None:
        self.stalled = False
        waiting, self._waiting = self._waiting, []
        for job in waiting:
            self.send(job)


class Wire:
    """Both directions, of one page."""

    def __init__(self, scheduler: object) -> None:
        self.up, self.down = Pipe(scheduler, 0.003), Pipe(scheduler, 0.003)
        self.changed = 0  # counts faults

    def stall(self, until: float, *, up: bool = True, down: bool = True) -> None:
        """The caller releases it then."""
        self.changed += 1
        for pipe in [self.up] * up + [self.down] * down:
            pipe.stall(until)

    def release(self) -> None:
        self.up.release()
        self.down.release()

    def delay(self, up: float, down: float) -> None:
        self.changed += 1
        self.up.delay, self.down.delay = up, down


class Link:
    """One socket of a page. ``delivered`` is called with each message of the server when it reaches the page."""

    def __init__(
        self, page: int, number: int, wire: Wire, server: WebServer, pages: Pages, delivered: Callable[[str], None]
    ) -> None:
        self.page, self.number = page, number
        self._wire, self._server, self._pages, self._delivered = wire, server, pages, delivered
        self._socket: ServerSocket | None = None
        self.first = 0  # how many commands pages had sent before
        self.broken = False  # nothing arrives any more
        self.closed = False  # as the page sees it
        wire.up.send(self._connect)

    @property
    def open(self) -> bool:
        return self._socket is not None and not self.broken and not self.closed

    # -- from the page

    def send(self, text: str) -> None:
        self._wire.up.send(lambda: self._reach(text))

    def close(self) -> None:
        """By the page, or because it is gone."""
        self.closed = True
        self._wire.up.send(lambda: self._reach(None))

    # -- what happens to the connection

    def reset(self, *, server_knows: bool = True) -> None:
        """Both ends notice at once that it is broken."""
        if self.broken:
            return
        self.broken = True
        self._notify_page()
        if server_knows:
            self._notify_server()

    def vanish(self) -> None:
        """Neither end notices by itself."""
        if not self.broken:
            self.broken = True
            self._server.scheduler.after(NOTICED_S, self._notify_server)

    # -- inside

    def _connect(self) -> None:
        if self.broken:
            return
        if not self._server.alive:
            self.broken = True
            self._notify_page()
            return
        self._server.do(self._accept)

    def _accept(self) -> None:
        if self.broken:
            return
        assert self._server.loop is not None
        self._socket = ServerSocket(self._server.loop, self._send_down, self._close_down)
        self._wire.down.send(lambda: self._to_page("open"))
        self._server.accept(self.page, self._socket)

    def _reach(self, text: str | None) -> None:
        if not self.broken:
            self._server.do(lambda: self._arrive(text))

    def _arrive(self, text: str | None) -> None:
        if self._socket is not None and self._server.alive:
            self._socket.arrive(text)
            self._server.wake()

    def _notify_server(self) -> None:
        life = self._server.lives
        self._server.do(lambda: life == self._server.lives and self._arrive(None))

    def _send_down(self, text: str) -> None:
        self._wire.down.send(lambda: self._to_page("message", text))

    def _close_down(self, code: int) -> None:
        self._wire.down.send(lambda: self._to_page("closed", code))

    def _notify_page(self) -> None:
        self._wire.down.send(lambda: self._pages.do(self.page, "network", self.number, "closed", LOST))

    def _to_page(self, what: str, value: str | int = "") -> None:
        if self.broken or self.closed:
            return
        if what == "message":
            self._delivered(str(value))
        self.closed = what == "closed"
        self._pages.do(self.page, "network", self.number, what, value)
