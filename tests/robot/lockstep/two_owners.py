"""Two motor owners of one robot in virtual time, and who drives them: the real services, on a network that delays.

Every step is possible at any time, and does nothing where it has no meaning, so steps can be left out of a schedule.

* No two drivers move the two owners at once: persons with a key, and all commands without one as one more.
* The first owner, by name, is moved only by who has control of it, or without a key while nobody has.
* The second one is moved only by whom the first has named less than 1.5 s ago.
* A script moves neither within 1.2 s after a person's command is over, that is, 2 s after it was sent.
* In the end, when everything works, who takes control drives both.

Most layouts have a bridge, persons are beyond it, and floods hold up what they send. Then the rules of stops hold, too:
:mod:`tests.robot.lockstep.stop_rules`.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import count
from pathlib import Path

from pebble.config import Config, load
from pebble.contract import CONTROL_STATE, CONTROL_TURN, ESTOP_STATE, codec
from pebble.runtime.process import view_of
from pebble.transports import Message, QoS
from tests.kit.schedules import Engine, Steps
from tests.robot.lockstep.drivers import BASE, SCRIPT, STRANGER, Commands, Driver
from tests.robot.lockstep.network import Network, Process, Scheduler
from tests.robot.lockstep.owner import Bridge, Disk, Outside, Owner, Wheels
from tests.robot.lockstep.stop_rules import StopRules

FIRST, SECOND = "arm", "serial"  # in the config the second comes first
FOLLOWS_S = 1.5
_HELD_S = 1.2
_MS = 0.0021
_CHECK_S = 0.05

_WAITS_S = (0.0, 0.001, 0.005, 0.02, 0.06, 0.1, 0.25, 0.5, 0.7, 1.0, 1.5, 1.61, 2.1, 3.0, 5.1)
_DELAYS_S = (0.0, 0.0, 0.003, 0.02, 0.06, 0.3, 0.7)
_DOWN_S = (0.02, 0.3, 0.8, 1.2, 3.0)
_FROZEN_S = (0.05, 0.3, 0.9, 1.4, 2.2, 5.0)
_FOR_MS = (1000, 3000, 3000, 10_000)
_STEERS_S = (0.3, 1.0, 2.0, 4.0, 8.0)
_LOST_S = (*_DOWN_S, 40.0)
_FLOODS_S = (1.5, 4.0, 9.0, 34.0)
_LAGS_S = (0.6, 0.8, 1.5, 2.5, 4.0)
_WRITES_S = (1.2, 0.05, 0.005)  # to a disk


def configuration(folder: Path, strangers: str, *, bridged: bool = False) -> Config:
    """A robot of two motor owners, whose files are in ``folder``."""
    lines = {"enabled": True, "serial": {"port": str(folder / "tty")}}
    lines["instances"] = {FIRST: {"serial": {"port": str(folder / "tty-arm")}}}
    transport = {"kind": "mqtt", "state_dir": str(folder / "state"), "run_dir": str(folder / "run")}
    raw = {"robot": {"id": "goob"}, "transport": transport, "local_mqtt": {"host": "127.0.0.1"}}
    raw |= {"services": {"serial_mcu_bridge": lines}, "security": {"strangers": strangers}}
    if bridged:
        bridge = {"enabled": True, "heartbeat": {"enabled": False}, "remote_mqtt": {"host": "127.0.0.1"}}
        raw["services"] |= {"mqtt_bridge": bridge}
    path = folder / f"{strangers}-{bridged}.json"
    path.write_text(json.dumps(raw))
    return load(path)


class TwoOwners:
    """``layout``: what strangers may do."""

    def __init__(self, layout: int, configs: tuple[Config, ...]) -> None:
        config = configs[layout % len(configs)]
        self.scheduler = Scheduler(10_000.0)
        self.commands = Commands()
        self.network = Network(self.scheduler, self._arrived, self._published)
        self.outside = Outside(self.scheduler, self._sent, self._comes)
        self.bridge = Bridge(self.network, self.outside, config) if config.services.mqtt_bridge.enabled else None
        numbers = count(1)
        disk: Disk = {}
        self.owners = {
            name: Owner(
                self.network, view_of(config, name.replace(SECOND, "")), disk, Wheels(self.scheduler),
                instance=name.replace(SECOND, ""), token_hex=lambda size: f"{next(numbers):0{2 * size}x}",
                writes_s=_WRITES_S[layout % len(_WRITES_S)] if self.bridge is not None else 0.0,
            )
            for name in (FIRST, SECOND)
        }  # fmt: skip
        self.stops = None if self.bridge is None else StopRules(self.scheduler, self.bridge, self.owners)
        away = self.network if self.bridge is None else self.outside
        networks = {"ann": away, "eve": away, STRANGER: self.network}
        self.drivers = {name: Driver(name, net, self.commands) for name, net in networks.items()}
        self.moved: set[tuple[str, str]] = set()  # (owner, driver)
        self._person_at: dict[str, float] = {}  # by owner: when a person moved it last
        self._granted: list[tuple[float, str]] = []  # when, and to whose id; what the first tells the second
        self._shown = (0.0, "")  # the same; what it tells everybody: both are lost while it has no connection
        self._recorded: list[Message] = []  # turns of the first
        self._run = 100
        for owner in self.owners.values():
            owner.after = partial(self._turned, owner)
            owner.start()
        if self.bridge is not None:
            self.bridge.start()
            self.scheduler.run(1.5)
        self._check_again()
        self.scheduler.run(0.8)

    # -- rules

    def _sent(self, _process: Process, message: Message) -> None:
        if self.stops is not None and _process is not self.bridge:
            self.stops.sent(message)

    def _comes(self, message: Message) -> None:
        if self.stops is not None:
            self.stops.comes(message)

    def _stops_published(self, process: Process, message: Message) -> None:
        assert self.stops is not None
        if process is self.bridge:
            self.stops.passes(message)
        elif process in self.drivers.values():
            self.stops.sent(message)
        for name, owner in self.owners.items():
            if process is owner and message.topic == ESTOP_STATE.topic(BASE, owner=name):
                self.stops.shows(name, message.payload)

    def _published(self, process: Process, message: Message) -> None:
        if self.stops is not None:
            self._stops_published(process, message)
        if process is self.owners[FIRST] and message.topic == CONTROL_TURN.topic(BASE, owner=FIRST):
            turn = codec.decode(CONTROL_TURN, message.payload)
            self._recorded = [*self._recorded, message][-8:]
            self._granted = [*self._granted, (self.scheduler.now, turn.id)][-100:]
        elif process is self.owners[FIRST] and message.topic == CONTROL_STATE.topic(BASE, owner=FIRST):
            self._shown = self.scheduler.now, codec.decode(CONTROL_STATE, message.payload).id

    def _arrived(self, process: Process, message: Message) -> None:
        if self.stops is not None and process is self.bridge:
            self.stops.learns(message)

    def _turned(self, owner: Owner) -> None:
        late = self.scheduler.now > owner.wheels.deadline + _MS
        self.scheduler.check(not late or owner.wheels.speeds is None, "a wheel turns after its command's deadline")
        self.check()

    def _check_again(self) -> None:
        self.check()
        if self.stops is not None:
            self.stops.check()
        self.scheduler.after(_CHECK_S, self._check_again)

    @property
    def holder(self) -> str:
        """Who has control, as the first owner shows; empty: nobody."""
        return next((driver.name for driver in self.drivers.values() if driver.id == self._shown[1]), "")

    def driver_of(self, name: str) -> str:
        """Return who moves this owner; empty: it stands still, or only the board's own deadline stops a frozen one."""
        wheels = self.owners[name].wheels
        if wheels.speeds is None or self.scheduler.now > wheels.deadline:
            return ""
        return self.commands.sender_of(wheels.speeds)

    def check(self) -> None:
        drivers = {name: self.driver_of(name) for name in self.owners}
        self.moved.update(drivers.items())
        for name, driver in drivers.items():
            if driver == SCRIPT:
                held = self.scheduler.now - self._person_at.get(name, 0.0) < _HELD_S
                self.scheduler.check(not held, "a script moves an owner soon after a person")
            elif driver:
                self._person_at[name] = self.scheduler.now
        persons = {driver for driver in drivers.values() if driver not in ("", SCRIPT)}
        self.scheduler.check(len(persons) < 2, "two drivers move the two owners")
        first, second = self.owners.values()
        newest = [*self._granted[-1:], self._shown]
        if drivers[FIRST] and first.alive and not first.frozen:
            self.scheduler.check(self._named(drivers[FIRST], newest), "the first obeys who has no control")
        if drivers[SECOND] and second.alive and not second.frozen:
            since = self.scheduler.now - FOLLOWS_S - _MS
            recent = [granted for granted in self._granted if granted[0] >= since]
            self.scheduler.check(self._named(drivers[SECOND], recent), "the second obeys whom the first does not name")

    def _named(self, driver: str, granted: list[tuple[float, str]]) -> bool:
        if driver == SCRIPT:
            return bool(granted)
        wanted = "" if driver == STRANGER else self.drivers[driver].id
        return wanted in [name for _, name in granted]

    # -- steps

    def do_wait(self, a: int, b: int) -> None:
        self.scheduler.run(_WAITS_S[b % len(_WAITS_S)])

    def do_linger(self, a: int, b: int) -> None:
        self.scheduler.run(16.0)

    def do_hold(self, a: int, b: int) -> None:
        self._person(a).hold(_FOR_MS[b % len(_FOR_MS)])

    def do_take(self, a: int, b: int) -> None:
        self._person(a).hold(_FOR_MS[b % len(_FOR_MS)], take=True)

    def do_flood(self, a: int, b: int) -> None:
        """Ask 50 times a second."""
        self._person(a).hold(10_000, period_s=0.02, take=b % 8 == 7, seconds=(0.3, 1.0, 2.5)[b % 3])

    def do_let_go(self, a: int, b: int) -> None:
        self._person(a).let_go(release=b % 4 != 0)

    def do_steer(self, a: int, b: int) -> None:
        self._person(a).steer(_STEERS_S[b % len(_STEERS_S)])

    def do_stranger(self, a: int, b: int) -> None:
        self.drivers[STRANGER].steer(_STEERS_S[b % len(_STEERS_S)], "")

    def do_old_key(self, a: int, b: int) -> None:
        person = self._person(a)
        if person.old_keys:
            person.drive(person.old_keys[b % len(person.old_keys)])

    def do_script(self, a: int, b: int) -> None:
        self._run += 1
        fields = {"source": "autonomy", "run": self._run - (b % 16 == 15)}
        self.drivers[STRANGER].steer(_STEERS_S[b % len(_STEERS_S)], "", **fields)

    def do_zero(self, a: int, b: int) -> None:
        self._anybody(a).zero(final=b % 2 == 0)

    def do_stop(self, a: int, b: int) -> None:
        self._anybody(a).stop(named=b % 8 != 7)

    def do_stop_again(self, a: int, b: int) -> None:
        self._person(a).stop_again(b // 2)

    def do_nameless(self, a: int, b: int) -> None:
        self._person(a).stop(named=False)

    def do_many(self, a: int, b: int) -> None:
        """More stops than an owner remembers."""
        for number in range(10):
            self.scheduler.after(0.02 * number, lambda: self._person(a).stop(named=b % 4 != 0))

    def do_withdraw(self, a: int, b: int) -> None:
        """The second owner ends, and its emergency stop is withdrawn, as by a launcher; it is back later, or not."""
        second = self.owners[SECOND]
        if second.alive and not second.frozen:
            second.kill(20.0 if b % 2 else None)
            topic = ESTOP_STATE.topic(BASE, owner=SECOND)
            self.drivers[STRANGER].publish_raw(topic, b"", retain=True)

    def do_lose_stops(self, a: int, b: int) -> None:
        if self.bridge is not None and self.bridge.alive and self.stops is not None:
            self.stops.doubtful = True
            self.bridge.lose_stops(_LAGS_S[a % 4], _DOWN_S[b % len(_DOWN_S)] + 0.4)

    def do_reset(self, a: int, b: int) -> None:
        self._anybody(a).reset()

    def do_kill(self, a: int, b: int) -> None:
        owner = self._owner(a)
        if owner.alive and not owner.frozen:
            owner.kill(_DOWN_S[b % len(_DOWN_S)])

    def do_freeze(self, a: int, b: int) -> None:
        self.freeze(self._owner(a), _FROZEN_S[b % len(_FROZEN_S)])

    def freeze(self, process: Process, seconds: float) -> None:
        if process.alive and not process.frozen:
            process.freeze()
            self.scheduler.after(seconds, process.thaw)

    def do_lag(self, a: int, b: int) -> None:
        """A flood: what persons send waits at their broker."""
        self.outside.flood(_FLOODS_S[b % len(_FLOODS_S)], _LAGS_S[a % len(_LAGS_S)])

    def do_stall(self, a: int, b: int) -> None:
        self.outside.stall(_LAGS_S[b % len(_LAGS_S)])

    def do_bridge(self, a: int, b: int) -> None:
        """The bridge is killed, frozen, or loses a connection."""
        if self.bridge is None or not self.bridge.alive or self.bridge.frozen:
            return
        if a % 4 == 0:
            assert self.stops is not None
            self.bridge.kill(_DOWN_S[b % len(_DOWN_S)])
            self.stops.begin()
        elif a % 4 == 1:
            self.freeze(self.bridge, _FROZEN_S[b % len(_FROZEN_S)])
        else:
            assert self.stops is not None
            self.stops.doubtful |= a % 8 != 2
            self.bridge.lose(_LOST_S[b % len(_LOST_S)], local=a % 8 == 2)

    def do_delay(self, a: int, b: int) -> None:
        process: Process = self._anybody(a) if a % 2 else self._owner(a // 2)
        if a == 4 and self.bridge is not None:
            process = self.bridge
        process.delay = _DELAYS_S[b % len(_DELAYS_S)]

    def do_lose(self, a: int, b: int) -> None:
        connection = self._owner(a).connection
        if connection is not None:
            connection.lose(_DOWN_S[b % len(_DOWN_S)])

    def do_repeat(self, a: int, b: int) -> None:
        self.network.repeat(self._owner(a), 1 + b % 4)

    def do_retain(self, a: int, b: int) -> None:
        """A broker has retained a turn: one of before, or one of before the machine was started, with any time."""
        if not self._recorded:
            return
        old = self._recorded[b % len(self._recorded)]
        turn = codec.decode(CONTROL_TURN, old.payload)
        fields = json.loads(old.payload) | {"t": int(1000 * self.scheduler.now) - 20 * (b % 4)} if a % 2 else None
        payload = old.payload if fields is None else json.dumps(fields | {"boot": turn.boot[::-1]}).encode()
        topic = CONTROL_TURN.topic(BASE, owner=FIRST)
        self.network.retained[topic] = Message(topic, payload, QoS.DELIVERED, retain=True)
        connection = self.drivers[STRANGER].connection
        assert connection is not None
        self.network.publishers[topic] = connection

    def _person(self, a: int) -> Driver:
        return self.drivers[("ann", "eve")[a % 2]]

    def _anybody(self, a: int) -> Driver:
        return list(self.drivers.values())[a % 3]

    def _owner(self, a: int) -> Owner:
        return self.owners[(FIRST, SECOND)[a % 2]]

    # -- the end

    def rest(self) -> None:
        """Everything works again; then who takes control drives both."""
        bridges = () if self.bridge is None else (self.bridge,)
        for process in (*self.owners.values(), *self.drivers.values(), *bridges):
            process.delay = 0.0
            process.thaw()
        self.outside.calm()
        for bridge in bridges:
            bridge.find()
        self.scheduler.run(5.2 if bridges else 3.2)
        for driver in self.drivers.values():
            driver.let_go(release=driver.name != STRANGER)
        self.scheduler.run(0.2)
        for owner in self.owners.values():
            owner.start()
        ann = self.drivers["ann"]
        if self.stops is not None:
            ann.stop()
            self.scheduler.run(4.0)
            repeats = self.stops.repeated_at > self.scheduler.now - 1.0
            self.scheduler.check(self.stops.all_latched, "a motor owner cannot be stopped any more")
            self.scheduler.check(not repeats, "the repetition of a stop does not end")
        for _ in range(3):
            ann.reset()
            self.scheduler.run(0.3)
        ann.hold(take=True)
        self.scheduler.run(0.3)
        ann.steer(1.0)
        self.scheduler.run(0.3)
        drivers = [self.driver_of(name) for name in self.owners]
        self.scheduler.check(drivers == ["ann", "ann"], "who has control does not drive both owners")
        ann.let_go(release=False)
        self.scheduler.run(4.7)
        self.scheduler.check(self._shown[1] == "", "who is silent keeps control")


_ALL = {
    "wait": 34, "hold": 5, "take": 5, "flood": 3, "let_go": 5, "steer": 12, "stranger": 5, "old_key": 3, "script": 3,
    "zero": 3, "stop": 1, "reset": 2, "kill": 5, "freeze": 6, "delay": 3, "lose": 2, "repeat": 3, "retain": 2,
}  # fmt: skip
_FLOODED = {
    "wait": 34, "hold": 8, "take": 3, "let_go": 2, "steer": 12, "lag": 8, "stall": 4, "bridge": 5, "freeze": 2,
    "kill": 1, "lose": 2, "delay": 3, "stranger": 2, "linger": 1,
}  # fmt: skip
_HANDOVERS = {
    "wait": 30, "take": 10, "hold": 4, "let_go": 8, "steer": 16, "stranger": 8, "old_key": 4, "freeze": 4, "kill": 3,
    "delay": 4, "repeat": 3,
}  # fmt: skip
_STOPPED = {
    "wait": 34, "stop": 10, "stop_again": 8, "nameless": 4, "many": 1, "reset": 12, "kill": 6, "freeze": 8, "lag": 2,
    "bridge": 1, "lose_stops": 1, "withdraw": 1, "delay": 2, "repeat": 1,
}  # fmt: skip


@contextmanager
def configs(_kind: str) -> Iterator[tuple[Config, ...]]:
    with tempfile.TemporaryDirectory(prefix="pbl") as folder:
        kinds = [(strangers, bridged) for bridged in (False, True, True) for strangers in ("free", "refuse")]
        yield tuple(configuration(Path(folder), strangers, bridged=bridged) for strangers, bridged in kinds)


def _perform(configs: tuple[Config, ...], schedule: Steps) -> None:
    layout, steps = schedule
    world = TwoOwners(layout, configs)
    for action, a, b in steps:
        getattr(world, "do_" + action)(a, b)
    world.rest()


ENGINE = Engine(
    mixes=(_ALL, _HANDOVERS, _FLOODED, _STOPPED),
    length=36,
    layouts=18,
    begin=[("take", 0, None), ("steer", 0, None), ("wait", 0, None)],
    world=configs,  # what schedules share
    perform=_perform,
)
