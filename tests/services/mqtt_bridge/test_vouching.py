"""Over which time the bridge vouches, and which motor owners it reaches: histories as rows."""

from __future__ import annotations

from typing import Any

import pytest

from pebble.runtime.parent import Notifier
from pebble.services.mqtt_bridge.motor_owners import MotorOwners
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


#: A motor owner is reached while its repeated state arrives; a retained one proves nothing.
#: Per second: m a message, c a new connection, . nothing.
CASES = {
    "nothing yet": ("." * 14, []),
    "never": ("." * 17, [False]),
    "one, perhaps retained": ("m" + "." * 13, []),
    "only a retained one": ("m" + "." * 20, [False]),
    "repeated": ("m....m....m....m", [True]),
    "then cut off": ("m....m" + "." * 20, [True, False]),
    "and back": ("m....m" + "." * 20 + "m", [True, False, True]),
    "a new connection with a retained one": ("m....m.cm" + "." * 20, [True, False]),
    "a new connection": ("m....mcm....m....m", [True]),
}


class Notes(Notifier):
    """Records reports; the launcher is too busy for the first one."""

    def __init__(self) -> None:
        super().__init__()
        self.reports: list[bool] = []
        self._busy = True

    def reaches(self, owner: str, reached: bool) -> bool:
        assert owner == "serial"
        busy, self._busy = self._busy, False
        self.reports += [] if busy else [reached]
        return not busy


@pytest.mark.parametrize(("seconds", "reports"), CASES.values(), ids=CASES)
def test_motor_owners(seconds: str, reports: list[bool]) -> None:
    notes = Notes()
    owners = MotorOwners("pebble/robots/goob", ["serial"], notes)
    (topic,) = owners.topics
    for now, second in enumerate(seconds):
        if second == "c":
            owners.connected()
        elif second == "m":
            owners.receive(topic)
        owners.check(float(now))
    assert notes.reports == reports
