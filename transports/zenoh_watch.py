"""Which hubs are there, and which links have been down: what a Zenoh transport's own thread waits for."""

from __future__ import annotations

import threading

import msgspec
import zenoh

from pebble.transports.zenoh_wire import UP

_LOST_LIMIT = 1000  # sessions whose return would be noticed


class View(msgspec.Struct, frozen=True):
    """``version`` changes with everything, ``connection`` only when a hub appears."""

    version: int
    connection: int
    hubs: frozenset[str]


class Watch:
    """Level-triggered: who waits sees the newest view, however many changes led to it."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._view = View(1, 0, frozenset())
        self._lost: dict[str, None] = {}
        self.closed = False

    @property
    def hubs(self) -> frozenset[str]:
        return self._view.hubs

    def follow(self, session: zenoh.Session) -> None:
        tokens = zenoh.handlers.Callback(self._hub, indirect=False)
        links = zenoh.handlers.Callback(self._link, indirect=False)
        session.liveliness().declare_subscriber(UP + "*", tokens, history=True)
        session.info.declare_transport_events_listener(links, history=True)

    def wait(self, seen: int, timeout: float | None) -> View | None:
        """The view, as soon as its version is not ``seen`` or after ``timeout`` seconds; None once closed."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self._view.version != seen, timeout)
            return None if self.closed else self._view

    def wait_closed(self, timeout: float) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self.closed, timeout)

    def close(self) -> None:
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def _hub(self, sample: zenoh.Sample) -> None:
        name = str(sample.key_expr).removeprefix(UP)
        with self._changed:
            if sample.kind == zenoh.SampleKind.PUT:
                self._change(hubs=self._view.hubs | {name}, appeared=1)
            else:
                self._change(hubs=self._view.hubs - {name})

    def _link(self, event: zenoh.TransportEvent) -> None:
        """A session that comes back under the same id was alive all the time, and we have missed what it said."""
        session = str(event.transport.zid)
        with self._changed:
            if event.kind == zenoh.SampleKind.DELETE:
                if len(self._lost) >= _LOST_LIMIT:
                    self._lost.pop(next(iter(self._lost)))
                self._lost[session] = None
            elif session in self._lost:
                del self._lost[session]
                self._change(hubs=self._view.hubs)

    def _change(self, hubs: frozenset[str], appeared: int = 0) -> None:
        self._view = View(self._view.version + 1, self._view.connection + appeared, hubs)
        self._changed.notify_all()
