"""The presence of hubs and siblings, the other peers: a watch on their tokens and connections, and a barrier."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

import msgspec
import zenoh

from pebble.transports.zenoh.callbacks import direct
from pebble.transports.zenoh.wire import LIVE, SYNC, UP

log = logging.getLogger(__name__)

_ASK_AGAIN_S = 0.05  # a sibling that was connected after the query was sent has not received it
_PAUSES_S = (0.001, 0.02)  # between queries, first and longest
_LOST_SESSIONS_LIMIT = 1000  # sessions whose return would be noticed


class HubView(msgspec.Struct, frozen=True):
    """The hubs that are present. ``version`` changes with every event, ``connection`` only when a hub appears."""

    version: int
    connection: int
    hubs: frozenset[str]


class HubWatch:
    """A watch for hubs, and for connections that were interrupted. :meth:`wait` returns the newest :class:`HubView`."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._view = HubView(1, 0, frozenset())
        self._lost_sessions: dict[str, None] = {}
        self.closed = False

    @property
    def hubs(self) -> frozenset[str]:
        return self._view.hubs

    def follow(self, session: zenoh.Session) -> None:
        """Watch the hubs and connections of ``session``."""
        tokens = zenoh.handlers.Callback(self._on_hub, indirect=False)
        connections = zenoh.handlers.Callback(self._on_connection, indirect=False)
        session.liveliness().declare_subscriber(UP + "*", tokens, history=True)
        session.info.declare_transport_events_listener(connections, history=True)

    def wait(self, seen: int, timeout: float | None) -> HubView | None:
        """Return the view once its version is not ``seen``, or after ``timeout`` seconds; None if closed."""
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

    def _on_hub(self, sample: zenoh.Sample) -> None:
        name = str(sample.key_expr).removeprefix(UP)
        with self._changed:
            if sample.kind == zenoh.SampleKind.PUT:
                self._change(hubs=self._view.hubs | {name}, appeared=1)
            else:
                self._change(hubs=self._view.hubs - {name})

    def _on_connection(self, event: zenoh.TransportEvent) -> None:
        """Note a lost connection; if it comes back under its id, announce that messages were missed."""
        session = str(event.transport.zid)
        with self._changed:
            if event.kind == zenoh.SampleKind.DELETE:
                if len(self._lost_sessions) >= _LOST_SESSIONS_LIMIT:
                    self._lost_sessions.pop(next(iter(self._lost_sessions)))
                self._lost_sessions[session] = None
            elif session in self._lost_sessions:
                del self._lost_sessions[session]
                self._change(hubs=self._view.hubs)  # the same hubs, but a new version

    def _change(self, hubs: frozenset[str], appeared: int = 0) -> None:
        self._view = HubView(self._view.version + 1, self._view.connection + appeared, hubs)
        self._changed.notify_all()


class Barrier:
    """A wait until every sibling knows this session's declarations, and this session theirs (T3).

    A query is answered only after the declarations sent before it on the same connection have been processed, in both
    directions. So a sibling that has answered ``@sync/<name>`` will send us what we subscribed to, and receive what we
    publish. The answer carries ``retained_count()``. Siblings know this session by its token.

    With ``by_name`` each sibling is asked by its name, as clients of hubs elsewhere do: otherwise all other clients
    there would answer, too (measured with 200 of them: opening a client took 3.3 to 7.3 s; by name 1.4 s).
    """

    def __init__(
        self, session: zenoh.Session, name: str, retained_count: Callable[[], int], *, by_name: bool = False
    ) -> None:
        self._session, self._name, self._retained_count = session, name, retained_count
        self._by_name = by_name
        self._silent: set[str] = set()  # hung or stopped: not waited for again until they answer
        session.declare_queryable(SYNC + name, direct(self._answer))
        self._token = session.liveliness().declare_token(LIVE + name)

    def synchronize(self, expected: Callable[[], dict[str, str]], timeout: float) -> dict[str, int]:
        """Wait up to ``timeout`` seconds for all ``expected`` siblings (name to a description for logs).

        Return how many retained messages each of them has sent, by name.
        """
        end = time.monotonic() + timeout
        pause, longest = _PAUSES_S
        answers: dict[str, int] = {}
        while missing := self._missing(expected(), answers):
            remaining_s = end - time.monotonic()
            if remaining_s <= 0:
                names = ", ".join(sorted(missing.values()))
                log.warning("%s did not answer within %.1f s and will not be waited for again", names, timeout)
                self._silent |= missing.keys()
                break
            if not self._ask(set(missing), answers, remaining_s):  # not all have answered
                time.sleep(pause)
                pause = min(2 * pause, longest)
        self._silent -= set(answers)
        return answers

    def _missing(self, expected: dict[str, str], answers: dict[str, int]) -> dict[str, str]:
        return {name: text for name, text in expected.items() if name not in self._silent and name not in answers}

    def _ask(self, wanted: set[str], answers: dict[str, int], remaining_s: float) -> bool:
        """Ask for the answers of ``wanted`` siblings, and wait a moment; return True if all are in ``answers``."""
        done = threading.Event()
        names = wanted if self._by_name else ["*"]
        ended: list[None] = []  # an entry for each query; appending is safe on any thread

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                sibling = str(reply.ok.key_expr).removeprefix(SYNC)
                answers[sibling] = int.from_bytes(reply.ok.payload.to_bytes(), "big")
                if wanted <= set(answers):
                    done.set()

        def end() -> None:
            ended.append(None)
            if len(ended) == len(names):
                done.set()

        for name in names:
            self._session.get(
                SYNC + name,
                zenoh.handlers.Callback(take, end, indirect=False),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=remaining_s,
            )
        done.wait(min(remaining_s, _ASK_AGAIN_S))
        return wanted <= set(answers)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            query.reply(SYNC + self._name, self._retained_count().to_bytes(8, "big"))
