"""Random schedules of stops and faults in virtual time: ``python -m tests.kit.schedules stops``.

The bridge's :class:`PassedStops` and :class:`Copies`, the latch of the motor owners and the sender of stops are real;
brokers, owners, files and people are models. Times are whole milliseconds. What must hold:

* **P1** A stop that the bridge has accepted latches each owner that runs, and is reached for a second, unless a reset
  that was sent later ended it. Excused: what a killed bridge forgets, and what an owner forgets that cannot save.
* **P2** No stop latches an owner again that has shown that it was reset. Excused: nameless stops around a loss of the
  connection of stops, and what a killed bridge forgets.
* **P6** Each repetition ends, what is remembered is bounded, and afterwards a new stop stops every owner.

``python -m tests.services.mqtt_bridge.stop_schedules NUMBER`` plants each fault and prints how many schedules find it.
"""

from __future__ import annotations

import heapq
import inspect
import operator
import random
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

from pebble.contract import CAPABILITIES, ESTOP, ESTOP_STATE, codec
from pebble.contract.payloads import Capabilities, EstopCommand, EstopState
from pebble.extensions.operator.client.estop import StopSender
from pebble.motion.latch import Latch
from pebble.services.mqtt_bridge import passed_stops
from pebble.services.mqtt_bridge.stop_connection import Copies, Way
from pebble.transports import Message
from tests.kit.schedules import Engine, Outcome, ViolatedError, shared

BASE = "pebble/robots/goob"
ACCEPTED_MS = 1000  # in which an accepted stop latches an owner that is reached
UNSAVING = 0.1  # share of owners that cannot save
NEVER = -(10**9)

#: One change each in passed_stops.py; with an empty one the copies of nameless stops are not recognised.
FAULTS: dict[str, tuple[str, str]] = {
    "one owner's confirmation ends it for all": (
        "self.pending = None\n\n\nclass",
        "self.pending.ended.append(1)\n        if self.pending and self.pending.ended:\n"
        "            self.pending = None\n\n\nclass",
    ),
    "an unsaved state that names it ends it": (" and (state.persisted is not False or not state.latched)", ""),
    "a reset seen later ends it": (
        "self.freed_at = now if",
        "self.pending = None if before.latched else self.pending\n            self.freed_at = now if",
    ),
    "an older stop's repetition replaces the newer": (" and not newer and", " and"),
    "names are forgotten over a reset": ("            if ended:", "            if False:"),
    "a nameless copy is not recognised": ("", ""),
    "pending is forgotten at a new boot": (
        "        self.withdrawn_at = None\n        #",
        "        self.pending = None if before is not None and before.boot != state.boot else self.pending\n"
        "        self.withdrawn_at = None\n        #",
    ),
    "an owner that is withdrawn has no end": (" if self._owners[key].withdrawn_at is None", ""),
    "the repetition names no owner": ('"why": command.why or UNSET}', '"why": command.why or UNSET, "owner": UNSET}'),
}


def planted(fault: str) -> Any:
    """The module with the fault; without one the module itself."""
    old, new = FAULTS.get(fault, ("", ""))
    if not old:
        return passed_stops
    text = inspect.getsource(passed_stops)
    assert text.count(old) == 1, fault
    text = text.replace(old, new)
    if "ended.append" in new:  # stops of one press share the list
        text = text.replace("    at: float\n", "    at: float\n    ended: list[int]\n")
        text = text.replace("Pending(stop, first, now)", "Pending(stop, first, now, shared)")
        text = text.replace("        now, name =", "        shared: list[int] = []\n        now, name =")
    if '"owner": UNSET' in new:
        text = text.replace("**(kept | fields)", "**(fields | kept)")
    module = ModuleType("planted")
    exec(compile(text, fault, "exec"), vars(module))
    return module


class Nameless(bytes):
    """A stop without a name: all have the same bytes. The rules know which press it is."""

    press: int

    def __new__(cls, press: int) -> Nameless:
        stop = super().__new__(cls, b"{}")
        stop.press = press
        return stop

    def __getitem__(self, _part: Any) -> Any:
        return self  # none is too long


class Time:
    """What is due when, and chance."""

    def __init__(self, seed: int) -> None:
        self.chance = random.Random(seed)
        self.now = 0
        self._due: list[tuple[int, int, Callable[..., None], tuple[Any, ...]]] = []
        self._number = 0

    def at(self, ms: int, what: Callable[..., None], *arguments: Any) -> None:
        self._number += 1
        heapq.heappush(self._due, (max(ms, self.now), self._number, what, arguments))

    def after(self, ms: int, what: Callable[..., None], *arguments: Any) -> None:
        self.at(self.now + ms, what, *arguments)

    def run(self, until: int) -> None:
        while self._due and self._due[0][0] <= until:
            self.now, _, what, arguments = heapq.heappop(self._due)
            what(*arguments)
        self.now = until

    def hex(self, digits: int) -> str:
        return f"{self.chance.getrandbits(4 * digits):0{digits}x}"


class Owner:
    """A motor owner: the real latch, and a file that is written later. Life by life it is killed and restarted."""

    def __init__(self, world: World, name: str, *, saves: bool, latches: bool) -> None:
        self.world, self.time, self.name, self.saves, self.latches = world, world.time, name, saves, latches
        self.file: Any = None
        self.life = 0
        self.shown_free: set[int] = set()  # presses that had latched it, and were shown to be reset
        self.reset_sent = -1  # when the newest reset that it has obeyed was sent
        self.lost_until = -1  # stops before this are forgotten: it cannot save
        self.start()

    def start(self) -> None:
        self.life += 1
        self.alive, self.frozen_at, self.deaf_until = True, None, 0
        self.waiting: list[tuple[Any, ...]] = []
        self.latch = Latch(self.time.hex(8), 8, operator.sub)
        if self.file is not None:
            self.latch.restore(dict(self.file))
        self.had: set[int] = set()
        self.unshown: set[int] = set()
        self.number = self.saved = self.written_at = 0
        self.published = [NEVER] * 4
        self.due = False
        self.reached_from = self.time.now
        self.changed()
        self.repeat(self.life)

    frozen_at: int | None

    def repeat(self, life: int) -> None:
        if life == self.life and self.alive:
            if self.frozen_at is None:
                self.changed()
            self.time.after(5000, self.repeat, life)

    def kill(self, back_ms: int) -> None:
        if not self.saves and self.latch.latched:
            self.lost_until = self.time.now
        self.alive = False
        self.life += 1
        self.time.after(back_ms, self.start)

    def freeze(self, ms: int, *, replaced: bool) -> None:
        if self.alive and self.frozen_at is None:
            self.frozen_at = self.time.now
            self.time.after(ms, self.thaw, self.life, replaced)

    def thaw(self, life: int, replaced: bool) -> None:
        if life != self.life or not self.alive or self.frozen_at is None:
            return
        if replaced:
            self.kill(self.time.chance.randint(200, 1500))
            return
        waiting, self.waiting = self.waiting, []
        if self.time.now - self.frozen_at > 2500:  # its connection was ended; what had been read may still be judged
            self.deaf_until = self.time.now + self.time.chance.randint(50, 500)
            waiting = self.time.chance.choice(([], waiting))
        self.frozen_at = None
        self.reached_from = max(self.time.now, self.deaf_until)
        self.judge(waiting)

    def deliver(self, what: tuple[Any, ...]) -> None:
        if not self.alive or self.time.now < self.deaf_until:
            return
        if self.frozen_at is None:
            self.judge([what])
        elif self.time.now - self.frozen_at < 2500:
            self.waiting.append(what)

    def judge(self, batch: list[tuple[Any, ...]]) -> None:
        """Stops first, and at most eight of each."""
        stops = [what for what in batch if len(what) == 1][-8:]
        for (payload,) in stops:
            self.stop(codec.decode(ESTOP, payload))
        for sent, boot, count in [what for what in batch if len(what) > 1][-8:]:
            if self.latch.reset(boot, count, 0, self.time.now):
                self.reset_sent = max(self.reset_sent, sent)
                self.unshown |= self.had
                self.save()
            self.changed()

    def stop(self, stop: EstopCommand) -> None:
        if not self.latches or (stop.owner != self.name and stop.owner in self.world.owners):
            return
        was_free = not self.latch.latched
        name = str(stop.stop)
        press = self.world.press_of(name)
        if self.latch.stop(name, "ann", "", 0):
            excused = press in self.world.doubtful or self.world.bridge.life > 1
            if was_free and press in self.shown_free and not excused:
                raise ViolatedError(f"P2: press {press} latches {self.name} again after a reset")
            self.had.add(press)
            self.save()
        self.changed()

    def save(self) -> None:
        self.number += 1
        self.written_at = max(self.time.now, self.written_at) + self.time.chance.choice((5, 20, 60, 300))
        self.time.at(self.written_at, self.wrote, self.life, self.number, self.latch.saved())

    def wrote(self, life: int, number: int, value: Any) -> None:
        if life != self.life or not self.alive or not self.saves:
            return
        if self.frozen_at is not None:
            self.time.after(500, self.wrote, life, number, value)
        elif number > self.saved:  # else a freeze had held it up; the real writer keeps the order
            self.file, self.saved = value, number
            if number == self.number:
                self.changed()

    def changed(self) -> None:
        """At most four states a second."""
        if self.time.now >= self.published[0] + 1000:
            self.published = [*self.published[1:], self.time.now]
            self.publish()
        elif not self.due:
            self.due = True
            self.time.at(self.published[0] + 1000, self.publish_due, self.life)

    def publish_due(self, life: int) -> None:
        if life != self.life or not self.alive:
            return
        if self.frozen_at is not None:
            self.time.after(200, self.publish_due, life)
            return
        self.due = False
        self.changed()

    def publish(self) -> None:
        if not self.latches:
            self.world.show(self.name, None)
            return
        fields: dict[str, Any] = self.latch.state(self.saved == self.number if self.saves else None)
        self.shown_free |= self.unshown
        self.unshown = set()
        self.world.show(self.name, EstopState(**fields))


class Bridge:
    """The real core of the bridge, with two connections to the operators' broker."""

    def __init__(self, world: World) -> None:
        self.world, self.time = world, world.time
        self.life = 0

    def start(self) -> None:
        self.life += 1
        self.alive = self.stops_there = True
        world = self.world
        clock = lambda: self.time.now / 1000  # noqa: E731
        self.copies = Copies(clock, 3.0)
        self.passed = world.module.PassedStops(world.owners, clock)
        world.sessions()
        for name, state in world.retained.items():
            self.time.after(self.time.chance.randint(20, 300), self.follow, self.life, name, state)
        self.repeat(self.life)

    def kill(self) -> None:
        if not self.alive:
            return
        for owner, press, first in self.pending():
            self.world.excuse(owner, press, first)
        self.alive = False
        self.life += 1
        self.time.after(self.time.chance.randint(500, 4000), self.start)

    def pending(self) -> list[tuple[str, int, int]]:
        """Which owners have not confirmed which press, and when that began to wait."""
        waiting = self.passed.pending.items()
        return [(key, self.world.press_of(one.stop.stop), round(1000 * one.at)) for key, one in waiting]

    def lose_stops(self) -> None:
        """The connection of stops is lost; that is noticed after a while, and it is made again."""
        if not self.alive or not self.stops_there:
            return
        self.world.doubtful |= self.world.nameless
        self.world.lost_stops = True
        self.stops_there = False
        life = self.life

        def noticed() -> None:
            for message in self.copies.lost() if life == self.life else ():
                self.accept(message.payload)

        def again() -> None:
            self.stops_there = self.stops_there or life == self.life

        self.time.after(self.time.chance.randint(0, 2800), noticed)
        self.time.after(self.time.chance.randint(2900, 9000), again)

    def receive(self, life: int, way: Way, payload: bytes, retain: bool) -> None:
        if life != self.life or not self.alive or retain or (way is Way.STOPS and not self.stops_there):
            return
        if not passed_stops.is_named(payload) and self.world.copies:
            other = self.stops_there or way is Way.STOPS
            if self.copies.is_copy(way, Message("estop", payload), other=other):
                return
        self.accept(payload)

    def accept(self, payload: bytes) -> None:
        press = self.world.press_in(payload)
        payload = passed_stops.named(payload)
        self.world.names[str(codec.decode(ESTOP, payload).stop)] = press
        payloads = self.passed.accept(payload)
        if payload in payloads:
            self.world.accepted(press)
        for passing in payloads:
            self.world.local((passing,))

    def repeat(self, life: int) -> None:
        if life != self.life or not self.alive:
            return
        self.passed.give_up()
        for payload in self.passed.repeat():
            self.world.repeats(payload)
            self.world.local((payload,))
        self.time.after(500, self.repeat, life)

    def follow(self, life: int, owner: str, state: EstopState | None) -> None:
        if life == self.life and self.alive:
            self.passed.follow(owner, state)
            self.world.show_remotely(owner, state)


class World:
    """A robot, its broker, its operators, and the rules."""

    def __init__(self, seed: int, fault: str = "") -> None:
        self.time = Time(seed)
        self.module, self.copies = planted(fault), "copy" not in fault
        self.owners: dict[str, Owner] = {}
        self.retained: dict[str, EstopState | None] = {}
        self.presses = 0
        self.names: dict[str, int] = {}  # presses, by name
        self.nameless: set[int] = set()
        self.doubtful: set[int] = set()  # nameless ones around a loss of the stops' connection
        self.lost_stops = False
        self.known: set[int] = set()
        self.obligations: list[tuple[int, int, set[str]]] = []  # when accepted, the press, owners that are excused
        self.view: dict[str, EstopState | None] = {}  # what operators see
        self.senders: list[StopSender] = []
        self.flood = 0, 0, 0
        self.last: dict[Any, int] = {}
        self.retained_stop: bytes | None = None
        self.local_operator = False
        chance = self.time.chance
        names = ["serial", "tail"] if chance.random() < 0.7 else ["serial"]
        self.refuser = chance.random() < 0.05
        self.bridge = Bridge(self)
        self.bridge.alive = False
        saves = [chance.random() > UNSAVING for _ in names]
        for name in names:
            latches = not (self.refuser and name == names[-1])
            self.owners[name] = Owner(self, name, saves=saves[len(self.owners)], latches=latches)
        self.bridge.start()
        value = {"estop": {"available": True, "owners": names}, "drive": {"available": True}}
        payload = codec.encode(CAPABILITIES, Capabilities(t=1, value=value))
        self.capabilities = Message(CAPABILITIES.topic(BASE), payload, retain=True)

    # -- the robot's own transport

    def local(self, what: tuple[Any, ...]) -> None:
        for owner in self.owners.values():
            self.time.after(self.time.chance.choice((1, 2, 5, 20)), owner.deliver, what)

    def show(self, owner: str, state: EstopState | None) -> None:
        self.retained[owner] = state
        at = self._in_order(("state", owner), self.time.chance.choice((1, 2, 5, 20, 20, 120)))
        if self.bridge.alive:
            self.time.at(at, self.bridge.follow, self.bridge.life, owner, state)
        if self.local_operator:
            self.time.at(at, self.see, owner, state)

    def show_remotely(self, owner: str, state: EstopState | None) -> None:
        if self.time.chance.random() > 0.02:
            at = self._in_order(("view", owner), self.time.chance.choice((10, 30, 100, 400)))
            self.time.at(at, self.see, owner, state)

    def see(self, owner: str, state: EstopState | None) -> None:
        self.view[owner] = state
        payload = b"" if state is None else codec.encode(ESTOP_STATE, state)
        for sender in self.senders:
            sender.receive(Message(ESTOP_STATE.topic(BASE, owner=owner), payload), self.time.now / 1000)

    def _in_order(self, key: Any, delay: int) -> int:
        at = self.last[key] = max(self.last.get(key, 0), self.time.now + delay)
        return at

    # -- the operators' broker

    def sessions(self) -> None:
        """The bridge has connected: nothing waits for it, and a retained stop comes with its mark."""
        for way in Way:
            self.last[way] = self.time.now
            if self.retained_stop is not None:
                self.time.after(100, self.bridge.receive, self.bridge.life, way, self.retained_stop, True)

    def broker(self, payload: bytes) -> None:
        """A stop has arrived; behind a flood it waits for the main connection, or is lost there."""
        if not self.bridge.alive:
            return
        for way in Way:
            delay = self.time.chance.choice((3, 10, 30))
            start, end, lag = self.flood
            if way is Way.MAIN and start <= self.time.now < end:
                delay += lag
                if self.time.chance.random() < 0.1:
                    continue
            self.time.at(self._in_order(way, delay), self.bridge.receive, self.bridge.life, way, payload, False)

    # -- people

    def new_press(self, name: str = "") -> int:
        self.presses += 1
        if name:
            self.names[name] = self.presses
        else:
            self.nameless.add(self.presses)
            if self.lost_stops:  # equal bytes cannot be told apart around a loss
                self.doubtful.add(self.presses)
        return self.presses

    def press_of(self, name: object) -> int:
        return self.names[str(name)]

    def press_in(self, payload: bytes) -> int:
        return payload.press if isinstance(payload, Nameless) else self.names[str(codec.decode(ESTOP, payload).stop)]

    def do_page(self) -> None:
        """A page repeats it until it is confirmed; some are sent once, or again by a client that lost its answer."""
        chance, name = self.time.chance, self.time.hex(16)
        self.new_press(name)
        net, once = chance.choice((5, 20, 20, 100, 2000)), chance.random() < 0.3
        now = self.time.now / 1000
        sender = StopSender(name, by="ann", why="", now=now, robots=[BASE])
        self.senders.append(sender)
        sender.receive(self.capabilities, now)
        for owner, state in self.view.items():
            payload = b"" if state is None else codec.encode(ESTOP_STATE, state)
            sender.receive(Message(ESTOP_STATE.topic(BASE, owner=owner), payload, retain=True), now)

        def send() -> None:
            for message in sender.tick(self.time.now / 1000):
                if message.topic == ESTOP.topic(BASE):
                    self.time.after(net, self.broker, message.payload)
                    if chance.random() < 0.05:
                        self.time.after(chance.choice((1000, 20_000, 60_000)), self.broker, message.payload)
            if once:
                sender.end()
            if sender.finished:
                self.senders.remove(sender)
            else:
                self.time.after(250, send)

        send()

    def do_nameless(self) -> None:
        """mosquitto_pub: once."""
        self.time.after(self.time.chance.choice((5, 20, 100)), self.broker, Nameless(self.new_press()))

    def do_many(self) -> None:
        for number in range(self.time.chance.randint(10, 60)):
            name = self.time.hex(16) if self.time.chance.random() < 0.7 else ""
            press = self.new_press(name)
            payload = codec.encode(ESTOP, EstopCommand(stop=name)) if name else Nameless(press)
            self.time.after(20 * number, self.broker, payload)

    def do_reset(self) -> None:
        """All owners that show a latch, as they were seen; the command may wait at the broker."""
        chance = self.time.chance
        for state in self.view.values():
            if state is not None and state.latched:
                delay = chance.choice((20, 20, 50, 300, 3000, 20_000))
                self.time.after(delay, self.pass_reset, self.time.now, state.boot, state.count)

    def pass_reset(self, sent: int, boot: str, count: int) -> None:
        life, (start, end, lag) = self.bridge.life, self.flood

        def pass_on() -> None:
            if self.bridge.life == life:
                self.local((sent, boot, count))

        if self.bridge.alive:
            at = self._in_order(Way.MAIN, 10 + (lag if start <= self.time.now < end else 0))
            self.time.at(at, pass_on)

    def do_kill(self) -> None:
        owner = self.time.chance.choice([*self.owners.values()])
        if owner.alive:
            owner.kill(self.time.chance.choice((300, 800, 2500, 12_000)))

    def do_freeze(self) -> None:
        owner = self.time.chance.choice([*self.owners.values()])
        ms, replaced = self.time.chance.choice(((900, False), (5000, False), (5000, False), (10_000, True)))
        owner.freeze(ms, replaced=replaced)

    # -- rules

    def accepted(self, press: int) -> None:
        if press not in self.known:  # a repetition obliges to nothing new
            self.known.add(press)
            self.obligations = [*self.obligations[-99:], (self.time.now, press, set())]

    def excuse(self, owner: str, press: int, at: int) -> None:
        """The bridge has forgotten this stop, and what waited no longer for it."""
        for when, other, excused in self.obligations:
            if other == press or when <= at + 1:
                excused.add(owner)

    def repeats(self, payload: bytes) -> None:
        owner = self.owners.get(str(codec.decode(ESTOP, payload).owner))
        if owner is not None and not owner.latches and self.time.now > self.accepted_at(payload) + 62_000:
            raise ViolatedError(f"P6: a stop is repeated to {owner.name}, which has withdrawn its own")

    def accepted_at(self, payload: bytes) -> int:
        press = self.press_in(payload)
        return next((at for at, other, _ in self.obligations if other == press), self.time.now)

    def check(self) -> None:
        now = self.time.now
        for owner in self.owners.values():
            if not owner.alive or owner.frozen_at is not None or owner.latch.latched or not owner.latches:
                continue
            for at, press, excused in reversed(self.obligations):
                if at <= max(owner.reset_sent, owner.lost_until):
                    break
                late = self.bridge.alive and now - max(at, owner.reached_from) > ACCEPTED_MS
                if late and owner.name not in excused:
                    raise ViolatedError(f"P1: {owner.name} is free {now - at} ms after press {press} was accepted")
        if self.bridge.alive and len(self.bridge.passed._passed) > passed_stops.NAMES:
            raise ViolatedError("P6: more names are remembered than may be")
        self.time.after(250, self.check)

    def perform(self) -> None:
        chance, at, end = self.time.chance, 1000, 40_000
        self.local_operator = chance.random() < 0.15
        if chance.random() < 0.4:
            start = chance.randint(0, 20_000)
            lag = chance.choice((2000, 10_000, 38_000, 55_000))
            self.flood, end = (start, start + chance.randint(2000, 15_000), lag), 110_000
        if chance.random() < 0.2:
            name = self.time.hex(16)
            self.new_press(name)
            self.retained_stop = codec.encode(ESTOP, EstopCommand(stop=name))
        acts: dict[Callable[[], None], float] = {
            self.do_page: 3, self.do_nameless: 3, self.do_reset: 6, self.do_many: 0.3, self.do_kill: 2,
            self.do_freeze: 3, self.bridge.lose_stops: 0.5, self.bridge.kill: 0.4,
        }  # fmt: skip
        for _ in range(chance.randint(4, 14)):
            at += chance.choice((0, 5, 30, 100, 300, 700, 2000, 5000))  # often close together: there the races are
            self.time.at(at, chance.choices([*acts], [*acts.values()])[0])
        self.time.after(250, self.check)
        self.time.run(end)
        self.rest(end)

    def rest(self, end: int) -> None:
        """Nothing more happens: what is repeated ends, and a new stop stops every owner."""
        self.time.run(end + (140_000 if self.refuser else 15_000))
        left = [(owner, press) for owner, press, _ in self.bridge.pending() if self.owners[owner].latches]
        if left:
            raise ViolatedError(f"P6: the repetition has not ended: {left}")
        name = self.time.hex(16)
        self.new_press(name)
        self.broker(codec.encode(ESTOP, EstopCommand(stop=name)))
        self.time.run(self.time.now + 3000)
        if not all(owner.latch.latched for owner in self.owners.values() if owner.latches):
            raise ViolatedError("P6: a motor owner cannot be stopped any more")


def _perform(fault: str, seed: int) -> Outcome:
    World(seed, fault).perform()
    return Outcome()


ENGINE = Engine(
    draw=lambda _kind, seed, number: seed * 1_000_000 + number,
    world=shared,
    perform=_perform,
    schedules=20_000,
    per_world=1000,
    repeats=False,
)


def search(fault: str, most: int) -> str:
    """Return how many schedules find the fault, and by which rule."""
    for number in range(most):
        if rule := ENGINE.violation(fault, number):
            return f"{number + 1:>6} {fault}: {rule}"
    return f"     - {fault}: not found"


if __name__ == "__main__":
    for planted_fault in sys.argv[2:] or FAULTS:
        sys.stdout.write(search(planted_fault, int(sys.argv[1])) + "\n")
        sys.stdout.flush()
