"""Over which time the bridge vouches: histories as rows."""

from __future__ import annotations

from typing import Any

import pytest

from pebble.services.mqtt_bridge.vouching import Vouching
from pebble.transports import Answer

START_S, PERIOD_S = 100.0, 0.5

#: Each half second: does it pass, what was lost, how old and how late the answer is (None: there is none); and from
#: when to when it vouches then.
GOOD = (True, 0, (0.2, 0.0))
HISTORIES: dict[str, tuple[tuple[Any, ...], ...]] = {
    "the first one proves nothing": ((*GOOD, (100.0, 100.0)), (*GOOD, (100.0, 100.3)), (*GOOD, (100.0, 100.8))),
    "a ping that is half a second late is prompt": ((*GOOD, (100.0, 100.0)), (True, 0, (0.4, 0.5), (100.0, 100.1))),
    "a ping that is later is not": (
        *((*GOOD, (100.0, 100.0)), (*GOOD, (100.0, 100.3)), (True, 0, (0.2, 0.501), (101.0, 101.0))),
        *((*GOOD, (101.0, 101.3)), (*GOOD, (101.0, 101.8))),
    ),
    "pictures on a thin link, or a broker that stalls: no answer comes": (
        *((*GOOD, (100.0, 100.0)), (True, 0, (0.7, 0.6), (100.5, 100.5)), (True, 0, (1.2, 1.1), (101.0, 101.0))),
        (*GOOD, (101.0, 101.3)),
    ),
    "an answer of before the beginning": ((*GOOD, (100.0, 100.0)), (True, 0, (3.0, 0.0), (100.0, 100.0))),
    "the newest answer is the one of before": (
        *((*GOOD, (100.0, 100.0)), (*GOOD, (100.0, 100.3)), (True, 0, (0.9, 0.0), (100.0, 100.3))),
    ),
    "something is lost": (
        *((*GOOD, (100.0, 100.0)), (True, 1, (0.2, 0.0), (100.5, 100.5)), (True, 1, (0.2, 0.0), (100.5, 100.8))),
    ),
    "a connection is lost": (
        *((*GOOD, (100.0, 100.0)), (False, 0, None, (100.5, 100.5)), (False, 0, (0.2, 0.0), (101.0, 101.0))),
        *((*GOOD, (101.5, 101.5)), (*GOOD, (101.5, 101.8))),
    ),
    "there is no answer yet": (
        *((True, 0, None, (100.0, 100.0)), (True, 0, None, (100.5, 100.5)), (*GOOD, (100.5, 100.8))),
    ),
}  # fmt: skip


class Remote:
    """What a transport knows."""

    answer: Answer | None = None


@pytest.mark.parametrize("name", HISTORIES)
def test_vouching(name: str) -> None:
    remote = Remote()
    vouching = Vouching(remote, START_S)  # type: ignore[arg-type]
    for number, (passes, losses, answer, vouched) in enumerate(HISTORIES[name]):
        remote.answer = None if answer is None else Answer(1, 0.0, None, *answer)
        shown = vouching.check(passes, losses, START_S + number * PERIOD_S)
        assert (shown.begin / 1000, shown.end / 1000) == vouched, number


def test_of_a_transport_that_asks_nothing_a_connection_that_lasts_is_prompt() -> None:
    vouching = Vouching(Remote(), START_S, 2.0)  # type: ignore[arg-type]
    vouched = [vouching.check(passes, 0, START_S + at) for at, passes in ((0, True), (1, True), (3, True), (4, False))]
    assert [(one.begin, one.end) for one in vouched] == [
        *((100_000, 100_000), (100_000, 100_000), (100_000, 101_000), (104_000, 104_000)),
    ]
