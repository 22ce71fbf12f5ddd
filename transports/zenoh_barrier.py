"""Waits until every sibling knows what this session has declared, and this session what they have (T3).

A query is answered only after the declarations that went before it on the same link have been taken in, in both
directions. So who has answered ``@sync/<name>`` will send us what we subscribed to, and will get what we publish.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

import zenoh

from pebble.transports.zenoh_wire import SYNC, pack_number, unpack_number

log = logging.getLogger(__name__)

_ASK_AGAIN_S = 0.05  # a sibling whose link came up after the question was asked has not heard it
_PAUSE_S = (0.001, 0.02)  # between questions, first and longest


class Barrier:
    """Answers siblings' questions for ``name`` with ``number()``, and asks them."""

    def __init__(self, session: zenoh.Session, name: str, number: Callable[[], int]) -> None:
        self._session, self._name, self._number = session, name, number
        self._silent: set[str] = set()  # hung, stopped: not waited for again until they answer
        handler = zenoh.handlers.Callback(self._answer, indirect=False)
        session.declare_queryable(SYNC + name, handler)

    def meet(self, expected: Callable[[], dict[str, str]], timeout: float) -> dict[str, int]:
        """Wait up to ``timeout`` seconds for all who are ``expected`` (what people call them, by name).

        Returns the numbers that came back, by name.
        """
        end = time.monotonic() + timeout
        pause, longest = _PAUSE_S
        answers: dict[str, int] = {}
        while wanted := self._missing(expected(), answers):
            left = end - time.monotonic()
            if left <= 0:
                who = ", ".join(sorted(wanted.values()))
                log.warning("%s did not answer within %.1f s and will not be waited for again", who, timeout)
                self._silent |= wanted.keys()
                break
            if not self._ask(set(wanted), answers, left):
                time.sleep(pause)
                pause = min(2 * pause, longest)
        self._silent -= set(answers)
        return answers

    def _missing(self, expected: dict[str, str], answers: dict[str, int]) -> dict[str, str]:
        return {name: who for name, who in expected.items() if name not in self._silent and name not in answers}

    def _ask(self, wanted: set[str], answers: dict[str, int], left: float) -> bool:
        done = threading.Event()

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                answers[str(reply.ok.key_expr).removeprefix(SYNC)] = unpack_number(reply.ok.payload.to_bytes())
                if wanted <= set(answers):
                    done.set()

        self._session.get(
            SYNC + "*",
            zenoh.handlers.Callback(take, done.set, indirect=False),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=left,
        )
        done.wait(min(left, _ASK_AGAIN_S))
        return wanted <= set(answers)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            query.reply(SYNC + self._name, pack_number(self._number()))
