"""The table of a robot's duties towards several drivers: control, and accounts where they are checked."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from typing import Any, Literal

import msgspec

from pebble import contract as c
from pebble.check_result import CheckResult, failed, ok, skipped
from pebble.contract.payloads import ControlRequest, ControlState, EstopReset
from pebble.extensions.checks.check import Check
from pebble.extensions.checks.conform.checks import BY, commanded, controls, drives, free, stops, while_stopped
from pebble.extensions.checks.observer import ANSWER_S, Observer
from pebble.extensions.operator.client.pace_of_link import ms

_SHORTEST_MS = 1000  # control ends so long after the last request or command, or later
_RENEWS_S = 0.3
SPEED = 0.4  # some motors are on or off, by a threshold
DRIVES_S, STEP_S = 0.6, 0.05
#: Where the broker itself refuses what has another name, or none, the robot never gets it.
UNSEEN = "its broker does not show this account that it delivers such a message"


class Driver:
    """A client that drives in a trial: it requests control, and signs commands with the key that it gets."""

    def __init__(self, robot: Observer, by: str = BY) -> None:
        self._robot, self._by, self.id = robot, by, secrets.token_hex(4)

    def request(self, want: Literal["hold", "release"] = "hold", for_ms: float = _SHORTEST_MS) -> ControlRequest:
        return ControlRequest(id=self.id, want=want, for_ms=for_ms, by=self._by)

    def asks(self, want: Literal["hold", "release"] = "hold", for_ms: float = _SHORTEST_MS) -> None:
        self._robot.send(c.CONTROL, self.request(want, for_ms))

    def leaves(self) -> bool:
        """Release control; return False if the robot still reports this driver as the holder."""
        self.asks("release")
        return self._robot.answers(lambda: not self.holds)

    def takes(self) -> float:
        """Take control from its present holder; return the time of the request (monotonic)."""
        return self._robot.send(c.CONTROL_TAKE, self.request())

    def send(self, z: object = 0, *, key: str | None = None, wrapped: bool = False, **fields: object) -> float:
        """Send one command; return the time of sending (monotonic). ``key`` replaces its own key; "" sends none.

        ``wrapped``: within ``{"value": …}``, which robots accept, too.
        """
        key = self.key if key is None else key
        command = {"x": 0, "z": z, **fields}
        if key:
            command["key"] = key
        return self._robot.send(c.DRIVE, msgspec.json.encode({"value": command} if wrapped else command))

    def drive(self, seconds: float = DRIVES_S, *, z: object = SPEED, **fields: Any) -> tuple[float, float]:
        """Send commands for ``seconds``, at the link's pace; return the times of the first and the last."""
        began = last = time.monotonic()
        pace = self._robot.view.pace
        while time.monotonic() < began + seconds:
            dated = {"t": ms(time.monotonic()), "valid_ms": pace.valid_ms} if pace.stamped else {}
            last = self.send(z, **dated | fields)
            self._robot.look(max(STEP_S, pace.step_s))
        return began, last

    @property
    def state(self) -> ControlState | None:
        return self._robot.view.control.state

    @property
    def key(self) -> str:
        """Return the keys of this driver's control, one for each motor owner; empty while it has no control."""
        keys = [state.key for state in self._robot.view.control.states if state.id == self.id]
        return " ".join(keys) if self.holds else ""

    @property
    def holds(self) -> bool:
        return self.state is not None and self.state.id == self.id and self.state.key != ""

    @property
    def may_drive(self) -> bool:
        """True if nobody else has control of the robot."""
        return self.holds or not self._robot.view.controlled


def _with_control(test: Callable[[Observer, Driver], CheckResult]) -> Callable[[Observer], CheckResult]:
    """Return a check that runs ``test`` with a driver that has control."""

    def run(robot: Observer) -> CheckResult:
        driver = Driver(robot)
        driver.asks()
        try:
            if not robot.answers(lambda: driver.holds):
                return failed(f"no key within {ANSWER_S:g} s", "answer incoming/control on outgoing/control/{owner}")
            return test(robot, driver)
        finally:
            driver.leaves()

    return run


def _first_keeps(robot: Observer, driver: Driver) -> CheckResult:
    """Check that the state names who has control, and that a second request does not take it."""
    by = "" if driver.state is None else driver.state.by
    if robot.view.named and by.partition("/")[0] != robot.account:
        return failed(f"its state tells that {by!r} has it", "at level named, by begins with the account in the topic")
    driver.asks(for_ms=5 * _SHORTEST_MS)  # longer than this test: the second must not get what has ended
    second = Driver(robot)
    second.asks()
    took = robot.happens(lambda: second.holds)
    second.leaves()
    if took:
        return failed("a second request takes it", "while one holds control, others wait: show them in asks")
    return ok("the first one keeps it")


def _shows_asker(robot: Observer, driver: Driver) -> CheckResult:
    """Check that the request of a second driver is shown, and no longer than it lasts."""
    driver.asks(for_ms=5 * _SHORTEST_MS)  # longer than this test: the second must not get what has ended
    second = Driver(robot)
    second.asks()

    def shown() -> bool:
        return driver.state is not None and driver.state.asks_id == second.id

    if not robot.answers(shown):
        return failed("a second request is not shown", "publish its by and id as asks and asks_id while it is repeated")
    if not robot.wait(lambda: not shown(), _SHORTEST_MS / 1000 + ANSWER_S):
        return failed("it is shown after its end", "who asks is shown until for_ms after the last request")
    return ok("the one who waits is shown, while it repeats that")


def _released(robot: Observer, driver: Driver) -> CheckResult:
    """Check that control ends by the release of who has it, and not by another's."""
    driver.asks(for_ms=5 * _SHORTEST_MS)
    Driver(robot).asks("release")
    if robot.happens(lambda: not driver.holds):
        return failed("another's release ends it", "a release counts with the id, and account, of who has control")
    if not driver.leaves():
        return failed("it is kept after its release", 'end it by {"want": "release"}')
    return ok("it ends by its release")


def _taken(robot: Observer, driver: Driver) -> CheckResult:
    """Check that control passes to a second driver that takes it from ``driver``, with a new key."""
    key, second = driver.key, Driver(robot)
    second.takes()
    took = robot.answers(lambda: second.holds)
    is_same_key = second.key == key
    second.leaves()
    if not took:
        return failed("the one who has it keeps it", "give control to who asks on incoming/control/take")
    if is_same_key:
        return failed("its key stays", "make a new key for each new holder")
    return ok("it passes on, with a new key")


def _ends(robot: Observer, driver: Driver) -> CheckResult:
    """Check that zero commands prolong control although they move nothing, and that control ends after the last one."""
    began = time.monotonic()
    while driver.holds and time.monotonic() < began + 1.5 * _SHORTEST_MS / 1000:
        driver.send()
        robot.look(_RENEWS_S)
    if not driver.holds:
        return failed("it ends in the middle of its commands", "end it for_ms after the last request or command")
    if not robot.wait(lambda: not driver.holds, _SHORTEST_MS / 1000 + 2 * ANSWER_S):
        return failed("it stays with who went away", "end it for_ms after the last request or command")
    return ok("commands prolong it, and it ends by itself")


def _nameless(robot: Observer, _name: str) -> CheckResult:
    fix = "at level named take requests and resets on incoming/by/{account}/… only"
    stranger = Driver(robot)
    if not robot.send_as("", c.CONTROL, stranger.request()):
        return skipped(UNSEEN)
    if robot.happens(lambda: stranger.holds):
        return failed("it gives control to a request without an account", fix)
    for state in robot.view.estop.states.values():
        robot.send_as("", c.ESTOP_RESET, EstopReset(boot=state.boot, count=state.count, by=BY))
    if robot.happens(lambda: not robot.view.latched):
        return failed("a reset without an account ends a stop", fix)
    return ok("requests and resets without an account do nothing")


def named(robot: Observer) -> bool:
    return robot.view.named


_CONTROL = (controls, free, commanded)

CONTROL: tuple[Check[Observer], ...] = (
    Check("control", _with_control(_first_keeps), _CONTROL, "one person drives at a time"),
    Check("control asked", _with_control(_shows_asker), _CONTROL, "who drives must see who waits"),
    Check("control released", _with_control(_released), _CONTROL, "the next one must not wait"),
    Check("control taken", _with_control(_taken), _CONTROL, "who is responsible must get it from who does not answer"),
    Check("control ends", _with_control(_ends), (drives, *_CONTROL), "who goes away must not keep it"),
    Check("nameless", while_stopped(_nameless), (stops, *_CONTROL), "it can be anybody's", binds=named),
)
