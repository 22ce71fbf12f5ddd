"""A motor owner is reached while its repeated state arrives; a retained one proves nothing."""

from __future__ import annotations

import pytest

from pebble.runtime.parent import Notifier
from pebble.services.mqtt_bridge.motor_owners import MotorOwners

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
