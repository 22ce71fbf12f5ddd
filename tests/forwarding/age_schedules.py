"""Random schedules of drivers, queues, clocks and strangers in virtual time: which drive commands count as too late.

``python -m tests.kit.schedules ages``. Nothing but the judge is real, with the pings of a connection: a command that
moves passes only if it was as fast as the others of its driver, and if no queue was there from the beginning that the
pings show. Zeros always pass, and who had a clock that is known is not refused while the way of the pings is busy.
"""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass, field
from functools import partial
from heapq import heapify, heappop, heappush
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec

from pebble.config import parse
from pebble.forwarding.command_ages import MOST, CommandAges, ends_something
from pebble.forwarding.subjects import Subjects
from pebble.transports import Message, clock
from pebble.transports.mqtt.read_age import BrokerDelay
from tests.kit.schedules import Engine, Outcome, RandomSteps, Steps, check, perform_steps, shared

_BASE = "pebble/robots/goob"
_SUBJECTS = Subjects(parse({"robot": {"id": "goob"}}, folder=Path("/"), env={}))
_DRIVE = _SUBJECTS[f"{_BASE}/incoming/drive-values"]
_WAYS_S = 0.15  # of a message, and of a ping each way
_LATE_S = 0.5
_DRIFTING_S = 0.07  # what the judge allows clocks to drift in a minute
_STEP_S = 0.05
_PING_S = 0.5
_WAITS_S = (0.2, 0.5, 1.0, 2.5, 5.0, 10.0, 20.0, 64.0)
_QUEUES_S = (0.0, 0.0, 0.0, 0.2, 0.4, 0.8, 1.5, 6.0)
_GROWTH = (0.0, 0.002, 0.006, 0.01, 0.03, 0.1, 0.3, 0.8)  # of a queue, seconds per second
_SET_S = (0.3, -0.3, 0.8, -0.8, 1.5, -1.5, 9.0, -9.0)
_RATES = (4, 5, 10)  # commands of a driver, a second
_USUAL_S = 63.0

LAYOUTS = ("own keys", "control", "names")


@dataclass
class Queue:
    """A first-in-first-out way whose delay is set, or grows."""

    delay_s: float = 0.0
    growth: float = 0.0
    last: float = 0.0

    def run(self, seconds: float) -> None:
        self.delay_s = min(max(0.0, self.delay_s + self.growth * seconds), 8.0)

    def leave_at(self, now: float) -> float:
        self.last = max(self.last, now + self.delay_s)
        return self.last


@dataclass
class Driver:
    """``ahead_s`` its clock shows more than the true time, and drifts by ``drift``."""

    account: str
    key: str
    ahead_s: float
    drift: float
    up: Queue = field(default_factory=Queue)
    per_s: int = 10
    driving: bool = False
    due: float = 0.0
    #: Since its clock was set or its key changed: when commands arrived, and their true delay.
    seen: list[tuple[float, float]] = field(default_factory=list)
    changed_at: float = 0.0
    fast_at: float = 0.0  # when a command of it was last not late
    key_at: float = 0.0  # when its key was new
    new_at: float = 0.0  # when its memory began
    known_at: float | None = None  # a fast command of it arrived while the pings were fast
    unusual_at: float = 0.0  # when its clock, or a delay of it, was last not as usual
    slow: bool = False  # its clock was set back, by too little to be seen: it seems slow
    set_back_at: float | None = None  # so was its clock, while it drove; since then nothing was late

    def stamp(self, now: float) -> int:
        return int(1000 * (1e6 + now * (1 + self.drift) + self.ahead_s))

    def begin_anew(self, now: float) -> None:
        self.seen.clear()
        self.changed_at, self.known_at = now, None
        self.unusual_at, self.set_back_at = now, None


@dataclass(order=True)
class Arrival:
    at: float
    number: int = 0
    sent: float = field(compare=False, default=0.0)
    driver: Driver | None = field(compare=False, default=None)  # None: the answer to a ping
    payload: bytes = field(compare=False, default=b"")
    account: str = field(compare=False, default="")
    down_s: float = field(compare=False, default=0.0)


class World:
    """What happened is in ``self.moved`` and ``self.refused``; a rule that is violated raises."""

    def __init__(self, layout: int) -> None:
        self.layout = LAYOUTS[layout % len(LAYOUTS)]
        self.now = 100.0
        self.chance = random.Random(layout)
        self.ages = CommandAges()
        self.drivers = [
            Driver("a" if self.layout == "names" else "", "0000000a", 0.0, 2e-4),
            Driver("b" if self.layout == "names" else "", "0000000b", -3.0, -2e-4),
            Driver("c" if self.layout == "names" else "", "0000000c", 5000.0, 0.0),
        ]
        for driver in self.drivers:
            driver.changed_at = driver.key_at = driver.new_at = driver.unusual_at = self.now
        self._share_keys()
        self.down, self.ping_up = Queue(), Queue()
        self.down_high_since: float | None = None
        self.delay, self.connected_at, self.pinged_at = BrokerDelay(), self.now, self.now
        self.delay.usual(2 * _WAYS_S)
        self.clear_connection = True
        self.at_broker: list[Arrival] = []  # or on the way there
        self.waiting: list[Arrival] = []  # on the way to the robot
        self.number = 0
        self.frozen_until = 0.0
        self.moved = self.refused = self.by_stamp = 0
        self.log: deque[str] = deque(maxlen=400)

    # -- steps

    def do_wait(self, _: int, b: int) -> None:
        self.run(_WAITS_S[b % 8])

    def do_drive(self, a: int, b: int) -> None:
        driver = self.drivers[a % 3]
        if not driver.driving:
            driver.unusual_at = self.now  # the minute for which it may be kept out begins with its first late command
        driver.driving, driver.per_s, driver.due = True, _RATES[b % 3], self.now

    def do_release(self, a: int, b: int) -> None:
        driver = self.drivers[a % 3]
        driver.driving, driver.set_back_at = False, None
        self._send(driver, moves=False, overtakes=b % 2 == 1)

    def do_up(self, a: int, b: int) -> None:
        queue = self.drivers[a % 3].up
        queue.delay_s, queue.growth = _QUEUES_S[b % 8], 0.0

    def do_up_grows(self, a: int, b: int) -> None:
        self.drivers[a % 3].up.growth = _GROWTH[b % 8] * (-1 if b >= 48 else 1)

    def do_down(self, _: int, b: int) -> None:
        self.down.delay_s, self.down.growth = _QUEUES_S[b % 8], 0.0

    def do_down_grows(self, _: int, b: int) -> None:
        self.down.growth = _GROWTH[b % 8] * (-1 if b >= 48 else 1)

    def do_pictures(self, _: int, b: int) -> None:
        """They wait on the way up, before our pings."""
        self.ping_up.delay_s = _QUEUES_S[b % 8]

    def do_set_clock(self, a: int, b: int) -> None:
        driver = self.drivers[a % 3]
        seconds = _SET_S[b % 8]
        driver.ahead_s += seconds
        known = driver.known_at is not None and driver.seen[-1][0] > self.now - 0.5
        driver.begin_anew(self.now)
        driver.slow |= seconds < 0
        if seconds > 8.0:
            driver.new_at = self.now
        if seconds < -8.0 and driver.driving and known:
            driver.set_back_at = self.now
        self._note(f"clock of {driver.key} is set by {seconds}")

    def do_change_key(self, a: int, b: int) -> None:
        driver = self.drivers[a % 3]
        driver.key = f"1{a % 3}{self.number:06x}"
        driver.key_at = driver.new_at = self.now
        driver.begin_anew(self.now)
        driver.slow = False
        self._share_keys()
        self._note(f"a new key: {driver.key}")

    def do_break(self, _: int, __: int) -> None:
        """The robot's connection is lost, with all that was on its way."""
        self.waiting.clear()
        self.at_broker = [one for one in self.at_broker if one.driver is not None]
        heapify(self.at_broker)
        self.delay = BrokerDelay()
        self.delay.usual(min(2 * _WAYS_S + self.ping_up.delay_s + self.down.delay_s, 1.0))
        self.clear_connection = self.ping_up.delay_s + self.down.delay_s < 0.05
        self.connected_at = self.pinged_at = self.now
        self._note("the connection is lost, and made again")

    def do_leave(self, a: int, _: int) -> None:
        """A driver's connection is lost, with what was on its way up."""
        driver = self.drivers[a % 3]
        driver.up.last = self.now
        self.at_broker = [one for one in self.at_broker if one.driver is not driver]
        heapify(self.at_broker)

    def do_freeze(self, _: int, b: int) -> None:
        """The robot's process stands still."""
        self.frozen_until = self.now + _WAITS_S[b % 5]

    def do_flood(self, a: int, b: int) -> None:
        """A stranger invents keys, or uses those of others under its own name, with any clock."""
        chance, steal = random.Random(b), self.layout == "names" and a % 2
        for driver in self.drivers:
            if len(driver.seen) < 2:
                driver.begin_anew(self.now)
        for number in range(3 * MOST):
            key = self.drivers[number % 3].key if steal else f"{chance.getrandbits(32):08x}"
            stamp = chance.choice((0, int(1000 * self.now), chance.getrandbits(50)))
            payload = msgspec.json.encode({"x": 0, "z": 0.5, "t": stamp, "key": key})
            self._judge(payload, "stranger" if self.layout == "names" else "", self.now)

    # -- time

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end:
            self.now += _STEP_S
            for queue in (self.down, self.ping_up, *(one.up for one in self.drivers)):
                queue.run(_STEP_S)
            high = self.down.delay_s > 0.75
            self.down_high_since = (self.down_high_since or self.now) if high else None
            for driver in self.drivers:
                if driver.up.delay_s + self.down.delay_s > 0.1 or self.now < self.frozen_until:
                    driver.unusual_at = self.now
                if driver.driving and self.now >= driver.due:
                    driver.due = self.now + 1 / driver.per_s
                    self._send(driver, moves=True)
            if self.now >= self.pinged_at + _PING_S:
                self._ping()
            while self.at_broker and self.at_broker[0].at <= self.now:
                self._pass_broker(heappop(self.at_broker))
            if self.now >= self.frozen_until:
                while self.waiting and self.waiting[0].at <= self.now:
                    self._arrive(heappop(self.waiting))

    def _ping(self) -> None:
        self.pinged_at = self.now
        self.delay.asked(self.now, clear=True)
        there = self.now + _WAYS_S + self.ping_up.delay_s
        self._put(Arrival(there))

    def _send(self, driver: Driver, *, moves: bool, overtakes: bool = False) -> None:
        axes = {"x": 0, "z": 0.5} if moves else {"x": 0, "z": 0}
        payload = msgspec.json.encode({**axes, "t": driver.stamp(self.now), "key": driver.key})
        there = self.now if overtakes else driver.up.leave_at(self.now)
        self._put(Arrival(there, 0, self.now, driver, payload, driver.account))

    def _put(self, one: Arrival) -> None:
        self.number += 1
        one.number = self.number
        heappush(self.at_broker, one)

    def _pass_broker(self, one: Arrival) -> None:
        leaves = self.down.leave_at(one.at)
        one.down_s, one.at = leaves - one.at, leaves + _WAYS_S
        heappush(self.waiting, one)

    def _arrive(self, one: Arrival) -> None:
        waited_s = max(self.delay.seconds(self.now, lambda: 2 * _WAYS_S), self._frozen_s(one))
        if one.driver is None:
            self.delay.answered(self.now)
            return
        driver, true_s = one.driver, self.now - one.sent - _WAYS_S
        moves = b"0.5" in one.payload
        late = self._judge(one.payload, one.account, self.now - waited_s if waited_s else None)
        check(moves or not late, "a zero was refused")
        if not moves:
            return
        if not self._counts(driver, one):
            if not self._has_control(driver):
                check(late == (waited_s > _LATE_S), "without a key that counts, it is not as the pings show")
            return
        if true_s < _LATE_S:
            driver.fast_at = self.now
        elif self.now - driver.fast_at > 60.0:
            driver.known_at = None
        if not driver.seen or self.now - driver.seen[-1][0] > 60.0:
            driver.known_at = None
        fast = true_s < 0.06 and not waited_s and driver.known_at is None
        if fast and driver.seen and not driver.slow:  # one alone may give way to a flood
            driver.known_at = self.now
        driver.seen.append((self.now, true_s))
        if true_s > 0.1 or waited_s:
            driver.set_back_at = None
        self.moved += not late
        self.refused += late
        self._note(f"{driver.key} {true_s:.2f} s, pings {waited_s:.2f}: {'late' if late else 'passes'}")
        if late:
            self._check_refused(driver, true_s, waited_s)
        else:
            self._check_passed(driver, one, true_s, waited_s)

    def _frozen_s(self, one: Arrival) -> float:
        return self.now - one.at if self.now - one.at > _STEP_S else 0.0

    def _counts(self, driver: Driver, one: Arrival) -> bool:
        """Whether its stamp counts: it was sent with the key of now, by its clock of now."""
        return driver.key.encode() in one.payload and one.sent > driver.changed_at and self._has_control(driver)

    # -- rules

    def _check_passed(self, driver: Driver, one: Arrival, true_s: float, waited_s: float) -> None:
        if true_s > _LATE_S + _DRIFTING_S:
            least = min(delay for at, delay in driver.seen if at >= self.now - 60.0)
            check(
                true_s <= least + _LATE_S + _DRIFTING_S, "a command moves that was more than 0.5 s slower than others"
            )
        self.by_stamp += waited_s > _LATE_S
        young = self.now - driver.seen[0][0] < 1.9 and driver.key_at == driver.changed_at
        check(not (young and waited_s > _LATE_S), "a new key makes a command fresher than the pings show")
        high = self.down_high_since
        standing = high is not None and self.clear_connection and self.connected_at < high < driver.new_at - 8.0
        check(not (standing and one.down_s > 0.75), "a queue that was there before is taken for the way")

    def _check_refused(self, driver: Driver, true_s: float, waited_s: float) -> None:
        usual = self.now - driver.unusual_at > _USUAL_S
        check(not (usual and true_s < 0.1 and not waited_s), "a driver is kept out for more than a minute")
        set_back = driver.set_back_at is not None and self.now > driver.set_back_at + 3.0
        check(not set_back, "a driver whose clock was set back is kept out for more than three seconds")
        known = driver.known_at is not None and self.now > driver.known_at + 2.1
        check(not (known and true_s < 0.3), "a driver whose clock is known is refused because of pings or strangers")

    # --

    def _judge(self, payload: bytes, account: str, since: float | None) -> bool:
        message = Message(f"{_BASE}/incoming/drive-values", payload, waiting_since=since)
        assert _DRIVE is not None
        return self.ages.waited_s(_DRIVE, message, account) > _DRIVE.waits_s and not ends_something(_DRIVE, message)

    def _share_keys(self) -> None:
        """Where there is control, the first driver has it."""
        if self.layout != "own keys":
            self.ages.keys = frozenset((self.drivers[0].key.encode(),))

    def _has_control(self, driver: Driver) -> bool:
        return self.layout == "own keys" or driver is self.drivers[0]

    def _note(self, what: str) -> None:
        self.log.append(f"{self.now:8.2f} {what}")


def _perform(_world: Any, schedule: Steps) -> Outcome:
    world = World(schedule[0])
    problems = []
    try:
        with mock.patch.object(clock, "since_boot", partial(getattr, world, "now")):
            perform_steps(world, schedule[1])
            world.run(1.0)
    except AssertionError as error:
        problems.append(str(error))
    counts: dict[str, float] = {"passed": world.moved, "late": world.refused, "passed by t": world.by_stamp}
    return Outcome(problems, counts, log=lambda: "\n".join(world.log))


_WEIGHTS = {
    "wait": 10, "drive": 6, "release": 2, "up": 2, "up_grows": 2, "down": 2, "down_grows": 2, "pictures": 3,
    "set_clock": 2, "change_key": 1, "break": 1, "leave": 1, "freeze": 1, "flood": 1,
}  # fmt: skip
_STANDING = {**_WEIGHTS, "down": 4, "change_key": 5, "set_clock": 4, "up": 0, "up_grows": 0, "break": 0}
_CALM = {**_WEIGHTS, "up": 1, "down": 1, "down_grows": 0, "set_clock": 1, "freeze": 0}

ENGINE = Engine(
    draw=RandomSteps(_WEIGHTS, _STANDING, _CALM, length=24, layouts=3, begin=(("drive", 0, None), ("wait", 0, None))),
    world=lambda _kind: shared(),
    perform=_perform,
)
