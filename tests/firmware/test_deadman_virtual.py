"""The dead-man's switch in virtual time: random schedules of faults.

Checked: motors are off at most 1.0 s after the last command that arrived; they follow the newest fresh command;
retained messages and nonsense never move them; no command moves them that left the broker more than 2.45 s ago (the
time in the broker's own queue is unknown); no turn of the loop blocks; after the faults the robot is online again
within 30 s and executes commands. While it is stopped nothing moves, also after a power cut once its state says that
this is saved.
"""

from __future__ import annotations

import errno
import json
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Final

import pytest

from pebble.extensions.lab.simulation.micropython.faults import failure
from pebble.extensions.lab.simulation.wireless import KINDS
from tests.ext.lab.simulation.virtual_network import Answers
from tests.firmware.drill import LIMIT_S, ONLINE, RESENT_S, START_S, Drill
from tests.kit.schedules import ViolatedError
from tests.support import cases, some

pytestmark = pytest.mark.computing


_NETWORK: Final = ("wifi", "broker", "hole", "dns", "ntp", "frozen", "mute")
_COMMANDS: Final = ("quiet", "flood", "retained", "stale", "stops")
FAULTS: Final = (*_NETWORK, *_COMMANDS, "i2c", "power", "disk")
ACT_S: Final = 8.0  # so long an operator drives and things go wrong
#: Then a connection is not about to be given up, and a board hears all again: after a flood at first only stops.
STABLE_S: Final = 4.5
BACK_S: Final = 30.0  # the longest waits are a back-off of 10 s, and 15 s until the Wi-Fi is rejoined

Change = Callable[[Drill], object]
Event = Callable[[Drill, float, float], None]

HOSTILE: Final = (
    b'{"x": 0, "z": NaN}',
    b'{"x": 0, "z": -1e999}',
    b'{"x": "nan", "z": "inf"}',
    b'{"z": 1',
    b"[1, 1]",
    b"",
    b'{"x": 0, "z": 1, "n": "\xff"}',
    b'{"a":' * 60 + b"1" + b"}" * 60,
    b'{"z": 1, "pad": "' + b"x" * 1100 + b'"}',
    b'{"z": 1, "pad": "' + b"y" * 5000 + b'"}',
)


def perform(drill: Drill, faults: tuple[str, ...] | None = None) -> None:
    """One whole schedule: act, come back, obey once more and stop. Raises ViolatedError."""
    act(drill, faults or tuple(drill.random.choice(FAULTS) for _ in range(drill.random.randint(1, 4))))
    _come_back(drill)
    _obey_again(drill)
    if drill.broker.violations or drill.board.resets:
        raise ViolatedError(f"{drill.broker.violations}, {drill.board.resets} resets")


def act(drill: Drill, faults: tuple[str, ...]) -> None:
    """The operator drives for ACT_S, while these faults occur."""
    random = drill.random
    drill.lossy = True
    _drive(drill, 1.0, ACT_S)
    for fault in faults:
        start = random.uniform(1.0, ACT_S - 1.0)
        length = min(ACT_S - start, random.choice((0.1, 0.5, 1.0, 1.7, 1.95, 2.5, 5.0)) * random.uniform(0.9, 1.1))
        _EVENTS[fault](drill, start, length)
    drill.run(ACT_S + 0.01)


def _drive(drill: Drill, start: float, end: float) -> None:
    """Bouts of driving at a steady pace; some end with a stop, some in silence."""
    random, at = drill.random, start
    while at < end:
        bout_end = min(end, at + random.uniform(0.2, 3.0))
        period, qos = 1 / random.uniform(4, 20), random.choice((0, 1, 1))
        held = (_wish(drill), _wish(drill), _wish(drill))
        steady = random.random() < 0.5
        while at < bout_end:
            drill.at(at, _command(drill, held if steady else (_wish(drill), _wish(drill), _wish(drill)), qos))
            at += period
        if random.random() < 0.4:
            drill.at(at, _command(drill, (0.0, 0.0, 0.0), qos))
        at += random.choice((0.0, 0.3, 1.2, 2.0))


def _wish(drill: Drill) -> float:
    return round(drill.random.uniform(-1.2, 1.2), 2)


def _command(drill: Drill, axes: tuple[float, float, float], qos: int) -> Callable[[], None]:
    return lambda: drill.quiet or drill.command(*axes, qos=qos)


def _come_back(drill: Drill) -> None:
    """The robot is online again within a bounded time, and publishes heartbeats."""
    drill.clear_sky()
    since = drill.seconds
    online = since + 0.001
    while drill.seconds < online + STABLE_S or len(drill.received(ONLINE, online)) < 2 or drill.broker.queued:
        drill.turn(0.04)
        if drill.robot.session.connection.state != "online":
            online = drill.seconds + 0.001  # what is still under way from an old connection does not count
        if drill.seconds > since + BACK_S:
            raise ViolatedError(
                f"not online {BACK_S:.0f} s after the last fault: {drill.robot.session.connection.reason}"
            )


def _obey_again(drill: Drill) -> None:
    """A robot that is stopped is reset; then it executes commands, and stops by itself."""
    since = drill.seconds
    while drill.robot.stops.latch.latched or drill.state()["latched"]:
        drill.reset()
        drill.wait(1.0)
        if drill.seconds > since + BACK_S:
            raise ViolatedError(f"it cannot be reset: {drill.state()}")
    drill.wait(LIMIT_S)
    start, moves = drill.seconds, drill.moves
    for number in range(5):
        drill.at(start + 0.1 * number, _command(drill, (0.0, 0.5 if number % 2 else -0.5, 0.0), 1))
    drill.run(start + 0.5 + 3 * RESENT_S)
    if drill.moves == moves:
        raise ViolatedError("it does not obey any more")
    drill.run(start + 2.5 + RESENT_S)
    if any(drill.outputs()):
        raise ViolatedError("it does not stop")


# -- faults: what happens to the drill, when, for how long


def _between(begin: Change, end: Change) -> Event:
    def fault(drill: Drill, start: float, length: float) -> None:
        drill.at(start, lambda: begin(drill))
        drill.at(start + length, lambda: end(drill))

    return fault


def _condition(name: str, value: object, after: object = False) -> Event:
    """Set a condition of the network for a while."""
    return _between(
        lambda drill: setattr(drill.network.conditions, name, value),
        lambda drill: setattr(drill.network.conditions, name, after),
    )


_hole = _condition("hole", True)
_frozen = _between(lambda drill: drill.broker.freeze(), lambda drill: drill.broker.thaw())
_quiet = _between(lambda drill: setattr(drill, "quiet", True), lambda drill: setattr(drill, "quiet", False))


def _dns(drill: Drill, start: float, length: float) -> None:
    """A broken name server matters to who has to connect again."""
    how = drill.random.choice(("silent", "nonsense", "no such name"))
    _condition("dns", how, "answers")(drill, start, length)
    drill.at(start + 0.1, drill.broker.kill)
    drill.at(start + 0.3, drill.broker.start)


def _ntp(drill: Drill, start: float, _length: float) -> None:
    how: Answers = drill.random.choice(("silent", "nonsense"))
    _condition("ntp", how, "answers")(drill, 0.0, start + 5.0)


def _flood(drill: Drill, start: float, length: float) -> None:
    """500 messages a second, most of them commands, some of them nonsense."""
    random = drill.random
    for number in range(int(500 * min(length, 2.0))):
        at = start + number / 500
        if random.random() < 0.3:
            drill.at(at, lambda: drill.nonsense(random.choice(HOSTILE), qos=random.choice((0, 1))))
        else:
            drill.at(at, _command(drill, (_wish(drill), _wish(drill), _wish(drill)), random.choice((0, 1))))


def _i2c(drill: Drill, start: float, length: float) -> None:
    drill.at(start, lambda: drill.failing_i2c(min(length, 0.5)))


def _retained(drill: Drill, start: float, length: float) -> None:
    """There is a retained command while the robot reconnects."""
    payload = b'{"x": 0, "z": 0.77, "y": 1}'
    drill.at(0.0, lambda: drill.nonsense(payload, retain=True))
    drill.at(start, drill.broker.drop_all)
    drill.at(start + length, lambda: drill.nonsense(b"", retain=True))


def _stale(drill: Drill, start: float, length: float) -> None:
    """The last commands before the operator lets go are held up on their way, or in the broker, for a while."""
    _quiet(drill, start + 0.2, ACT_S)
    (_hole if drill.random.random() < 0.7 else _frozen)(drill, start, max(length, drill.random.uniform(1.5, 4.0)))


def _stops(drill: Drill, start: float, length: float) -> None:
    """Presses, each repeated; then resets, of which some are made from an older state."""
    random = drill.random
    for _ in range(random.choice((1, 1, 2))):
        name = f"{random.getrandbits(64):016x}"
        pressed = start + random.uniform(0.0, 0.3)
        for number in range(random.randint(1, 4)):
            drill.at(pressed + 0.5 * number, partial(drill.stop, name))
    for _ in range(random.randint(0, 3)):
        drill.at(start + random.uniform(0.1, length + 0.5), partial(drill.reset, behind=random.choice((0, 0, 1))))


def _power(drill: Drill, start: float, _length: float) -> None:
    drill.at(start, drill.cut_power)


def _disk(drill: Drill, start: float, length: float) -> None:
    """The file system cannot be written to for a while, and there is a stop."""

    def full(*_: object) -> None:
        raise failure(errno.ENOSPC)

    _stops(drill, start, length)
    drill.at(start, lambda: setattr(drill.board.files, "before", full))
    drill.at(start + length, lambda: setattr(drill.board.files, "before", lambda *_: None))


_EVENTS: Final[dict[str, Event]] = {
    "stops": _stops,
    "power": _power,
    "disk": _disk,
    "wifi": _between(lambda drill: drill.network.radio.lose(), lambda drill: drill.network.radio.restore()),
    "broker": _between(lambda drill: drill.broker.kill(), lambda drill: drill.broker.start()),
    "hole": _hole,
    "dns": _dns,
    "ntp": _ntp,
    "frozen": _frozen,
    "quiet": _quiet,  # nothing comes from the broker but answers to pings
    "flood": _flood,
    "i2c": _i2c,
    "retained": _retained,
    "stale": _stale,
    "mute": _condition("mute", True),  # packets of the robot are lost, packets to it are not
}


MIXED, SINGLE = cases(25, 700), cases(2, 30)  # schedules per robot; of each fault alone
FIRST_SINGLE = 700  # seeds of single faults begin here


@pytest.mark.parametrize("kind", KINDS)
def test_motors_obey_the_newest_fresh_command_and_stop_without_one(kind: str) -> None:
    drills = [_performed(kind, seed) for seed in range(MIXED)]
    assert sum(drill.moves for drill in drills) > 10 * MIXED  # they were driven indeed
    trips = sum(drill.robot.deadman.trips for drill in drills)
    assert trips > MIXED // 2, "and often stopped by the dead-man's switch only"
    assert sum(drill.robot.refused for drill in drills) > MIXED
    assert sum(drill.robot.stops.latch.count for drill in drills) > MIXED // 10


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("kind", KINDS)
def test_each_fault_alone(kind: str, fault: str) -> None:
    for seed in range(SINGLE):
        _performed(kind, FIRST_SINGLE + seed, fault)


def _performed(kind: str, seed: int, *faults: str) -> Drill:
    drill = Drill(kind, seed)
    try:
        perform(drill, *([faults] if faults else []))
    except ViolatedError as error:
        raise ViolatedError(f"{kind}, seed {seed}, {faults or 'mixed faults'}: {error}") from None
    return drill


@pytest.mark.parametrize("fault", some(["flood", "quiet", "ntp", "i2c"], 2))
@pytest.mark.parametrize("kind", KINDS)
def test_the_heartbeat_continues(kind: str, fault: str) -> None:
    """Four times a second, whatever happens beside it, and stamped by a clock that never goes back."""
    for seed in range(cases(4, 10)):
        drill = Drill(kind, seed)
        act(drill, (fault,))
        received = [one for one in drill.broker.received if one.message.topic == ONLINE and one.at > START_S + 5.0]
        times = [one.at for one in received]
        assert (times[-1] - times[0]) / (len(times) - 1) == pytest.approx(0.25, rel=0.1)
        assert max(later - earlier for earlier, later in pairwise(times)) < 0.25 + 2 * RESENT_S
        stamps = [json.loads(one.message.payload)["t"] for one in received]
        assert all(later > earlier for earlier, later in pairwise(stamps))
