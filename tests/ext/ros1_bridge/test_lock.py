"""Locks of a ROS 1 base: an opened one is sent again until a base has surely received it."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from pebble.services.ros1_bridge import cmd_vel
from pebble.services.ros1_bridge.cmd_vel import CmdVel
from tests.support import Clock


class Subscribers:
    """The bases that receive what is sent, if any."""

    def __init__(self) -> None:
        self.names = {"base"}

    def advertise(self, *_: str) -> Subscribers:
        return self

    def send(self, _body: bytes) -> int:
        return len(self.names)


#: Each lock (True) and reset, whether a base is reached; whether it is connected two seconds later, and what is owed.
LOCKS = {
    "told, and still connected": ([(True, True), (False, True)], True, False),
    "told, and gone since": ([(True, True), (False, True)], False, True),
    "no base at the reset": ([(True, True), (False, False)], True, True),
    "locked again without a base": ([(True, True), (False, True), (True, False), (False, False)], True, True),
}


@pytest.mark.parametrize(("locks", "connected", "owed"), LOCKS.values(), ids=LOCKS)
def test_a_reset_is_owed_until_a_base_has_surely_received_it(
    monkeypatch: pytest.MonkeyPatch, locks: list[tuple[bool, bool]], connected: bool, owed: bool
) -> None:
    clock, saved, bases = Clock(), list[bool](), Subscribers()
    monkeypatch.setattr(cmd_vel, "time", SimpleNamespace(monotonic=clock))
    sender = CmdVel(bases, "/cmd_vel", 0.05, "/e_stop", None, save=saved.append)  # type: ignore[arg-type]
    for locked, reached in locks:
        bases.names = {"base"} if reached else set()
        sender.latch(locked)
    bases.names = {"base"} if connected else set()
    sender.settle()
    assert saved == [True], "not at once"
    clock.now += 2.1
    sender.settle()
    assert saved[-1] is owed
