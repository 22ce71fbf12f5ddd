"""Motor owners, networks, files, persons and scripts in virtual time; the rules of owners and senders are real ones.

A step is ``(action, a, b)``: the method ``do_<action>`` with two small numbers. Every step is possible at any time, and
does nothing where it has no meaning, so that steps can be left out of a history.
"""

from __future__ import annotations

import json
import operator
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from pebble.extensions.lab.simulation.micropython.loader import FirmwareModules
from pebble.extensions.operator.client.estop import StopSender
from pebble.transports import Message, QoS
from tests.kit.schedules import Step, check
from tests.motion.rules import (
    GIVE_UP_MS,
    MISSING,
    PERSON,
    REFUSED,
    REPEAT_MS,
    UNKNOWN_RUN,
    UNREADABLE,
    WATCHDOG_MS,
    Client,
    ControlRules,
    Rules,
)

BASE = "pebble/robots/goob"

CORE_NAMES = ("latch", "lease", "arbiter", "ticks")

Command = tuple[Any, ...]  # (what, owner, when it was sent, whether it is a retained copy, ...)


def load_cores() -> Any:
    """The cores from the firmware, and the sender of stops."""
    modules = FirmwareModules({"micropython": SimpleNamespace(const=lambda value: value)})
    latch, lease, arbiter, ticks = (modules.module(f"common.{name}") for name in CORE_NAMES)
    return SimpleNamespace(
        Latch=latch.Latch, Lease=lease.Lease, Arbiter=arbiter.Arbiter, diff=ticks.diff, StopSender=StopSender
    )


CORES = load_cores()

#: Which owners a robot has: Linux, board, and one that cannot save anything.
LAYOUTS = ("L", "B", "N", "LL", "BL", "LN", "BB", "L", "B", "LB")

WAITS = (
    0, 1, 10, 49, 50, 100, 100, 250, 250, 499, 500, 501,
    749, 750, 999, 1000, 1999, 2000, 2001, 5000, 60_000, 290_000,
)  # fmt: skip
#: Who drives: ids may be copied, and people of one server have the same account.
CLIENTS = (
    *(Client("ann", "aaaaaaaa", "ann", "phone"), Client("ann", "bbbbbbbb", "ann"), Client("mia", "aaaaaaaa", "mia")),
    *(Client("page-1", "dddddddd", "page-1/eve"), Client("page-1", "eeeeeeee", "page-1/bob")),
    Client("otto", "cccccccc", "otto"),
)  # fmt: skip
FOR = (0, 1000, 3000, 3000, 3000, 10_000, 1 << 40)
STRANGERS = (0, 1, 2, 0)
VALID = (-1, -1, -1, 100, 400, 750, 751, 5000)
STALE_MS = 2000  # a command that moves something and is older is dropped on its way
INBOX_MS = 500
STATE_MS = 250  # at most four states a second
FOREVER = 1 << 60
HOLDER = -2  # the place in the inbox of who has control
WRITTEN, SYNCED, RENAMED = 1, 2, 3
LAST_RUN = (1 << 30) - 1  # after it comes 1

#: Files that are no state; ``None`` stands for what JSON cannot parse.
CORRUPT: tuple[Any, ...] = (
    *(None, [], {}, 7, "latched", {"latched": 1, "recent": []}, {"latched": False}, {"recent": []}),
    *({"latched": False, "recent": {}}, {"latched": None, "recent": []}, {"latched": "false", "recent": []}),
)


class Keys:
    """Makes keys of control: numbers, so that the same calls make the same keys in MicroPython."""

    def __init__(self, first: int) -> None:
        self.next = first

    def __call__(self, _count: int) -> str:
        self.next += 1
        return f"{self.next - 1:08x}"


class Owner:
    """The process or the board that commands motors: the cores, and a model of what is around them."""

    def __init__(self, world: World, index: int, kind: str, cores: Any, wrap: int) -> None:
        self.world, self.index, self.kind, self.cores = world, index, kind, cores
        self.names = 4 if kind == "B" else 8
        self.diff: Callable[[int, int], int] = cores.diff if kind == "B" else operator.sub
        self.runs_from = 0 if wrap % 2 else LAST_RUN - 3  # owners receive run 1 as the one after this
        self.offset = (1 << 30) - wrap if kind == "B" else 1_000_000
        self.mask = (1 << 30) - 1 if kind == "B" else (1 << 62) - 1
        self.rules = Rules(self.names)
        self.durable: Any = MISSING  # the file after a power cut: (what the core saved, what it must contain)
        self.visible: Any = MISSING  # the file for programs
        self.writable = True
        self.deaf: tuple[str, ...] = ()  # commands that do not arrive
        self.boots = 0
        self.up = False
        self.cut_while_writing = 0
        self.states: list[dict[str, Any]] = []  # published, the newest last, with the order of that step
        self.start(0)

    def clock(self, now: int) -> int:
        return (now + self.offset) & self.mask

    @property
    def barred(self) -> int:
        return (self.arbiter.barred - self.runs_from) % LAST_RUN if self.arbiter.barred else 0

    def start(self, now: int) -> None:
        cores = self.cores
        self.up = True
        self.boots += 1
        self.latch = cores.Latch(f"{self.index}{self.boots:07x}", self.names, self.diff)
        self.written: Any = self.visible
        self.version, self.saved_version = 0, 0  # of the state; of the file
        if self.visible != MISSING:
            self.latch.restore(self.visible[0])
            self.version = 1  # to be written again: an earlier process may have ended before the file was durable
        strangers = STRANGERS[self.world.layout % 4]
        keys = Keys((self.index + 1 << 28) + (self.boots << 16))
        self.lease = cores.Lease(self.clock(now), self.diff, keys, strangers)
        self.rules.control = ControlRules(strangers, self.lease)
        self.arbiter = cores.Arbiter(self.latch, self.lease, self.clock(now), self.diff, WATCHDOG_MS)
        self.requests: list[Command] = []
        self.stage, self.writing_version = 0, 0
        self.writing: Any = None
        self.inbox: dict[int, Command] = {}  # by run, PERSON, or HOLDER
        self.resets: list[Command] = []
        self.stops: list[Command] = []
        self.slot: tuple[bool, int] | None = None  # the newest admitted command: whether it moves, its deadline
        self.until = 0  # the wheels turn before this time
        self.managed_until = FOREVER  # runs of before may move, until their manager has received the new state
        self.published_at, self.unpublished = now - STATE_MS, True
        self.rules.started(now, MISSING if self.visible == MISSING else self.visible[1], self.latch.latched)
        self.publish(now)

    def cut(self, how: int) -> None:
        """The process ends (0), or its power is cut before (1) or after (2) the disk has what is renamed."""
        self.up = False
        self.until = 0
        if how == 1:
            self.visible = self.durable
        elif how == 2:
            self.durable = self.visible

    # -- commands

    def receive(self, message: Command, now: int, order: int) -> None:
        what, _, _, copy = message[:4]
        if copy:  # it is stale
            return
        if self.kind == "B":
            self._execute(message, now, now, order)
        elif what == "stop":
            self.stops = [*self.stops, message][-8:]
        elif what == "reset":
            self.resets.append((*message, now))
        elif what == "control":
            self.requests.append(message)
        else:
            moves, run, _, keys, by = message[4:9]
            self.rules.received(moves, run)
            key = HOLDER if run == PERSON and self.lease.holds(keys, by or "") else run
            old = self.inbox.pop(key, None)
            if old is not None and not old[4]:
                self._drive(old, now)
            self.inbox[key] = (*message, now)

    def work(self, now: int, order: int) -> None:
        """One turn of a Linux owner's thread."""
        for message in self.stops:
            self._stop(message, now, order)
        self.stops = []
        for message in self.resets:
            self._reset(message, now - message[-1], now, order)
        self.resets = []
        for message in self.requests:
            self._request(message, now)
        self.requests = []
        for message in self.inbox.values():
            if not message[4] or now - message[-1] < INBOX_MS:
                self._drive(message, now)
        self.inbox = {}
        self.rules.worked()

    def apply(self, now: int) -> None:
        """What is in the slot reaches the motors."""
        if self.slot is not None:
            moves, until = self.slot
            self.slot = None
            self.until = until if moves else 0

    def _execute(self, message: Command, now: int, read: int, order: int) -> None:
        if message[0] == "stop":
            self._stop(message, now, order)
        elif message[0] == "reset":
            self._reset(message, now - read, now, order)
        elif message[0] == "control":
            self._request(message, now)
        else:
            self._drive(message, now)
            self.apply(now)

    def _stop(self, message: Command, now: int, order: int) -> None:
        _, _, _, copy, name, given = message
        self.rules.executes(copy)
        by = ("anna", "otto", "otto/pad", "vera?")[int(name, 16) % 4]
        new = self.arbiter.stop(name, by, "", now)
        if new:
            self._halt()
        self.rules.stopped(name, by, given, order, self.latch, now < self.until or self.slot is not None)
        if new:
            self._changed()
        self.publish(now)

    def _reset(self, message: Command, age: int, now: int, order: int) -> None:
        _, _, _, copy, boot, count, asked = message[:7]
        self.rules.executes(copy)
        ended = self.latch.reset(boot, count, age, self.clock(now))
        self.rules.reset(boot, count, age, asked, now, order, self.latch)
        if ended:
            self._changed()
        self.publish(now)

    def _halt(self) -> None:
        self.slot = None
        self.until = 0

    def _request(self, message: Command, now: int) -> None:
        _, _, sent, copy, who, for_ms, over = message
        self.rules.executes(copy)
        if for_ms is None:
            self.lease.release(who, self.clock(now))
            self.rules.control.released(who, now)
        elif now - sent < STALE_MS:
            self.lease.hold(who, for_ms, over, self.clock(now))
            self.rules.control.requested(who, for_ms, over, now)
        self.halt_if_passed_on(now)

    def halt_if_passed_on(self, now: int) -> None:
        """The motors stop before anything else when another one has control."""
        if self.lease.halts:
            self.lease.halts = False
            self._halt()
        self.rules.passed_on(self.lease.key, now < self.until or self.slot is not None)

    def _drive(self, message: Command, now: int) -> None:
        _, _, sent, copy, moves, run, valid, keys, by = message[:9]
        if moves and now - sent >= STALE_MS:
            return
        self.rules.executes(copy)
        number = (run - 1 + self.runs_from) % LAST_RUN + 1 if run > 0 else run
        result = self.arbiter.judge(moves, number, valid, self.clock(now), keys, by)
        self.halt_if_passed_on(now)
        self.rules.judged(moves, run, valid, keys, by, now, result)
        if result > 0 and 0 < run <= self.rules.barred_before and run not in self.world.rogues:
            check(now < self.managed_until, "a run moves that was barred before a restart its manager has received")
        if result != REFUSED:
            self.slot = (result > 0, now + result)
        if self.barred != self.published_barred:
            self.publish(now)

    # -- state

    def _changed(self) -> None:
        self.version += 1
        if self.kind == "B":
            self.write_board()

    def publish(self, now: int) -> None:
        self.unpublished = True
        self.flush(now)

    def flush(self, now: int) -> None:
        if self.unpublished and self.up and now - self.published_at >= STATE_MS:
            self.unpublished = False
            self.published_at = now
            state = self.latch.state(self.persisted)
            self.published_barred = state["barred"] = self.barred
            state["order"] = self.world.order
            if state["persisted"]:
                self.rules.saved(MISSING if self.durable == MISSING else self.durable[1], self.kind == "L")
            self.states.append(state)
            if len(self.states) > 6:
                del self.states[0]

    published_barred = 0

    @property
    def persisted(self) -> bool | None:
        if self.kind == "N":
            return None
        if self.kind == "B":
            return bool(self._latched_in_file() == self.latch.latched)
        return self.saved_version == self.version

    def _latched_in_file(self) -> bool:
        return bool(self.written != MISSING and (self.written[1] == UNREADABLE or self.written[0]["latched"]))

    def write_board(self) -> None:
        """A board writes at once, when free becomes latched or the other way round."""
        if self._latched_in_file() == self.latch.latched and not (
            self.written != MISSING and self.written[1] == UNREADABLE
        ):
            return
        how, self.cut_while_writing = self.cut_while_writing, 0
        if self.writable and how != 1:
            self.visible = self.durable = self.written = (self.latch.saved(), self.rules.snapshot())
        if how:
            self.up = False

    def write(self, now: int) -> None:
        """The next part of writing the file."""
        if self.kind == "B":
            self.write_board()
            self.publish(now)
        elif self.kind == "L":
            self._write_linux(now)

    def _write_linux(self, now: int) -> None:
        if self.stage == 0:
            if self.saved_version != self.version and self.writable:
                self.writing = (self.latch.saved(), self.rules.snapshot())
                self.writing_version = self.version
                self.stage = WRITTEN
        elif self.stage == WRITTEN:
            self.stage = SYNCED
        elif self.stage == SYNCED:
            self.visible = self.written = self.writing
            self.stage = RENAMED
        else:
            self.durable = self.writing  # the directory is synchronised, too
            self.saved_version = self.writing_version
            self.stage = 0
            self.publish(now)


class Sender:
    """A stop or a hold of a person, sent by the real sender. Its messages are read back from their topics."""

    def __init__(self, cores: Any, name: str, given: int, now: int, owners: int, hold: bool) -> None:
        self.name, self.given, self.owners, self.hold = name, given, owners, hold
        self.began, self.sent_at, self.ended = now, now - FOREVER, False
        self.states: dict[int, dict[str, Any]] = {}
        self.settled = False  # confirmed, and every owner that can save it has, or was reset
        self._stop = cores.StopSender(name, by="anna", why="", now=now / 1000, robots=[BASE], hold=hold)
        estop = {"available": True, "owners": [f"mcu{owner}" for owner in range(owners)]}
        self._stop.receive(_published("capabilities", {"t": 1, "value": {"estop": estop}}), now / 1000)

    @property
    def confirmed(self) -> bool:
        return bool(self._stop.confirmed)

    @property
    def saved(self) -> bool:
        return bool(self._stop.robots[BASE].saved)

    @property
    def at_rest(self) -> bool:
        return bool(self._stop.finished or self.settled)

    def receive(self, owner: int, state: dict[str, Any], now: int) -> None:
        self.states[owner] = state
        message = state.get("message")
        if message is None:
            message = state["message"] = _published(f"estop/mcu{owner}", state)
        self._stop.receive(message, now / 1000)
        states = self.states.values()
        self.settled = self.confirmed and (
            self.settled or all(state["persisted"] is not False or not state["latched"] for state in states)
        )

    def tick(self, now: int) -> list[bool]:
        """What is sent: True for the stop, False for a final zero."""
        silent = self.settled or self.ended or (not self.hold and now > self.began + GIVE_UP_MS)
        due = now > self.sent_at + REPEAT_MS and (self.hold or now < self.began + GIVE_UP_MS)
        sent = [message.topic.endswith("/estop") for message in self._stop.tick(now / 1000)]
        if sent:
            check(not silent, "a stop is repeated that is confirmed and saved, ended or 60 s old")
            check(now >= self.sent_at + REPEAT_MS, "a stop is repeated too soon")
            self.sent_at = now
        elif due:
            check(silent, "a stop that is not confirmed, or not saved, is not repeated")
        check(sent in ([], [True, False]), "a stop is sent without a zero after it")
        return sent

    def end(self) -> None:
        self.ended = True
        self._stop.end()


def _published(metric: str, body: dict[str, Any]) -> Message:
    return Message(f"{BASE}/outgoing/{metric}", json.dumps(body).encode(), QoS.DELIVERED)


class World:
    """One robot and all who send to it."""

    def __init__(self, layout: int, cores: Any = CORES) -> None:
        kinds = LAYOUTS[layout % len(LAYOUTS)]
        self.cores = cores
        self.now = 0
        self.order = 0
        self.rogues: set[int] = set()
        self.layout, self.named = layout, layout % 3 == 0
        self.owners = [Owner(self, index, kind, cores, 1 + layout * 997 % 9000) for index, kind in enumerate(kinds)]
        self.network: list[Command] = []
        self.retained: list[dict[str, Command]] = [{}]  # saves of the broker: by topic; the newest one counts
        self.seen: list[dict[int, dict[str, Any]]] = [{}, {}]  # by person, then owner
        self.keys: list[dict[int, str]] = [{} for _ in CLIENTS]  # of control as each knows them, by owner
        self.senders: list[Sender] = []
        self.presses = 0
        # the manager of scripts, and their runs
        self.known: dict[int, dict[str, Any]] = {}
        self.at_start: dict[int, tuple[str, int]] = {}
        self.saved_run = 0
        self.run = 0  # the one that is active

    def perform(self, steps: list[Step]) -> None:
        for action, a, b in steps:
            self.order += 1
            getattr(self, "do_" + action)(a, b)

    # -- time and networks

    def do_wait(self, a: int, b: int) -> None:
        self.now += WAITS[b % len(WAITS)]
        for owner in self.owners:
            if owner.up:
                if owner.kind != "B":
                    owner.apply(self.now)
                if owner.until > self.now:
                    owner.rules.moving(self.now, owner.until)
                owner.arbiter.tick(owner.clock(self.now))
                owner.halt_if_passed_on(self.now)
                owner.rules.ticked(self.now, owner.barred)
                owner.flush(self.now)

    def do_deliver(self, a: int, b: int) -> None:
        if self.network:
            self._deliver(self.network.pop(b % len(self.network) if a > 4 else 0))

    def do_duplicate(self, a: int, b: int) -> None:
        if self.network:
            self._deliver(self.network[b % len(self.network)])

    def do_lose(self, a: int, b: int) -> None:
        if self.network:
            del self.network[b % len(self.network)]

    def do_all(self, a: int, b: int) -> None:
        """The network delivers everything in order, and the owners work."""
        network, self.network = self.network, []
        for message in network:
            self._deliver(message)
        for owner in self.owners:
            if owner.up:
                owner.work(self.now, self.order)
                owner.apply(self.now)

    def _drive(self, moves: bool, run: int, valid: int, keys: str = "", by: str | None = None) -> None:
        """Without a ``by`` it is from a program of the robot, where names are checked."""
        self._send("drive", moves, run, valid, keys, by if self.named else "")

    def _send(self, what: str, *fields: Any) -> None:
        for owner in range(len(self.owners)):
            self.network.append((what, owner, self.now, False, *fields))
        if len(self.network) > 24:
            del self.network[:2]

    def _deliver(self, message: Command) -> None:
        owner = self.owners[message[1]]
        if owner.up and message[0] not in owner.deaf:
            owner.receive(message, self.now, self.order)

    def do_deaf(self, a: int, b: int) -> None:
        """From now on stops, or all commands, or none are lost on their way to one owner."""
        self.owners[b % len(self.owners)].deaf = (("stop",), ("stop", "reset", "drive"), ())[a % 3]

    def do_retain(self, a: int, b: int) -> None:
        """A command that is on its way also replaces what the broker retains on its topic."""
        if self.network:
            message = self.network[b % len(self.network)]
            self.retained = [*self.retained[-3:], {**self.retained[-1], message[0]: message}]

    def do_subscribe(self, a: int, b: int) -> None:
        """An owner connects again: it publishes its state and receives what the broker has retained."""
        owner = self.owners[b % len(self.owners)]
        if owner.up:
            owner.publish(self.now)
            for what, _, _, _, *fields in self.retained[-1].values():
                self._deliver((what, owner.index, self.now, True, *fields))

    def do_restore(self, a: int, b: int) -> None:
        """The broker is restored from an older save."""
        self.retained.append(self.retained.pop(b % len(self.retained)))
        for index in range(len(self.owners)):
            self.do_subscribe(a, index)

    # -- persons

    def do_drive(self, a: int, b: int) -> None:
        self._drive(True, PERSON, VALID[b % len(VALID)])

    def do_release(self, a: int, b: int) -> None:
        self._drive(False, PERSON, VALID[b % len(VALID)])

    def do_halt(self, a: int, b: int) -> None:
        self._drive(False, PERSON, 0)

    # -- persons who have control, want it, or have had it

    def _client(self, b: int) -> Client:
        client = CLIENTS[b % len(CLIENTS)]
        return client if self.named else client._replace(account="")

    def do_hold(self, a: int, b: int) -> None:
        self._send("control", self._client(b), FOR[b % len(FOR)], a == 0)

    def do_let_go(self, a: int, b: int) -> None:
        self._send("control", self._client(b), None, False)

    def do_learn(self, a: int, b: int) -> None:
        """A client receives who has control; one in four times it learns another's key."""
        for index, owner in enumerate(self.owners):
            if owner.up and (a % 4 == 0 or owner.lease.holder == self._client(b)):
                self.keys[b % len(CLIENTS)][index] = owner.lease.key

    def do_steer(self, a: int, b: int) -> None:
        """A client drives by the keys that it knows, the ones of now or of before; one in eight is a zero."""
        who = b % len(CLIENTS)
        keys = " ".join(key for _, key in sorted(self.keys[who].items()) if key)
        self._drive(a != 0, PERSON, VALID[b % len(VALID)], keys, CLIENTS[who].account)

    def do_signed(self, a: int, b: int) -> None:
        """A script elsewhere sends under a client's keys."""
        if self.run:
            keys = " ".join(key for key in self.keys[b % len(CLIENTS)].values() if key)
            self._drive(a != 0, self.run, VALID[b % len(VALID)], keys, self._client(b).account)

    def do_control(self, a: int, b: int) -> None:
        """A client asks, is answered, and drives."""
        self.do_hold(a, b)
        self.do_all(a, b)
        self.do_learn(1, b)
        self.do_steer(1, b)

    def do_press(self, a: int, b: int) -> None:
        """A person gives a stop, with a sender that repeats it.

        One in four is a hold, and one in sixteen is for a robot that lists one more owner, which never answers.
        """
        self.presses += 1
        if len(self.senders) > 5:
            self.senders.pop(0)
        name, hold, owners = f"{self.presses:016x}", b % 4 == 0, len(self.owners) + (b % 16 == 1)
        self.senders.append(Sender(self.cores, name, self.order, self.now, owners, hold))
        self._note_confirmed(self.senders[-1], (False, False))
        self.do_send(len(self.senders) - 1, b)

    def do_nameless(self, a: int, b: int) -> None:
        """A stop without a name: the owner makes one."""
        self.presses += 1
        self._send("stop", f"f{self.presses:015x}", self.order)

    def do_see(self, a: int, b: int) -> None:
        """A person, the manager or a sender receives a state; an older one if a broker was restored."""
        owner = b % len(self.owners)
        states = self.owners[owner].states
        if not states:
            return
        state = states[-1 - min(b >> 4, len(states) - 1)] if a == 7 else states[-1]
        self._show(a if a < 7 else b % 7, owner, state)

    def _show(self, who: int, owner: int, state: dict[str, Any]) -> None:
        if who < 2:
            self.seen[who][owner] = state
        elif who == 2:
            if state["boot"] == self.owners[owner].latch.boot:
                self.owners[owner].managed_until = min(self.owners[owner].managed_until, self.now + STALE_MS)
            self._manage(owner, state)
        elif self.senders:
            sender = self.senders[who % len(self.senders)]
            before = sender.confirmed, sender.settled
            sender.receive(owner, state, self.now)
            self._note_confirmed(sender, before)

    def _note_confirmed(self, sender: Sender, before: tuple[bool, bool]) -> None:
        if before == (sender.confirmed, sender.settled) or not sender.confirmed:
            return
        check(sender.owners == len(self.owners), "a stop is confirmed without an answer of every owner")
        for index, owner in enumerate(self.owners):
            owner.rules.confirms(sender.name, sender.states.get(index))
        saved = all(state["persisted"] for state in sender.states.values())
        check(sender.saved == saved, "a stop counts as saved that is not, or the other way round")

    def do_reset(self, a: int, b: int) -> None:
        owner = b % len(self.owners)
        state = self.seen[a % 2].get(owner)
        if state is not None:
            self.network.append(("reset", owner, self.now, False, state["boot"], state["count"], self.order))

    def do_look_and_reset(self, a: int, b: int) -> None:
        self.do_see(a % 2, b)
        self.do_reset(a % 2, b)

    # -- senders

    def do_send(self, a: int, b: int) -> None:
        if self.senders:
            sender = self.senders[a % len(self.senders)]
            for stop in sender.tick(self.now):
                if stop:
                    self._send("stop", sender.name, sender.given)
                else:
                    self._drive(False, PERSON, 0)

    def do_end_sender(self, a: int, b: int) -> None:
        if self.senders:
            self.senders[a % len(self.senders)].end()

    # -- scripts

    def do_start_run(self, a: int, b: int) -> None:
        known = self.known
        if a:
            for owner in range(len(self.owners)):
                self.do_see(2, owner)
        if self.run or len(known) < len(self.owners) or any(state["latched"] for state in known.values()):
            return
        self.run = self.saved_run = max(self.saved_run, *(state["barred"] for state in known.values())) + 1
        self.at_start = {owner: (state["boot"], state["count"]) for owner, state in known.items()}

    def do_script(self, a: int, b: int) -> None:
        if self.run:
            self._drive(a != 0, self.run, VALID[b % len(VALID)])

    def do_rogue(self, a: int, b: int) -> None:
        """A run that its manager has ended, or an unknown one, goes on sending."""
        run = b % (self.saved_run + 2)
        if run or a == 0:
            self.rogues.add(run)
            self._drive(a != 0, run or UNKNOWN_RUN, VALID[b % len(VALID)])

    def do_end_run(self, a: int, b: int) -> None:
        if self.run:
            self._drive(False, self.run, -1)
            self.run = 0

    def do_restart_manager(self, a: int, b: int) -> None:
        self.known = {}
        self.run = 0

    def _manage(self, owner: int, state: dict[str, Any]) -> None:
        self.known[owner] = state
        if self.run:
            changed = (state["boot"], state["count"]) != self.at_start[owner]
            if state["latched"] or changed or state["barred"] >= self.run:
                self.do_end_run(0, 0)

    # -- owners

    def do_work(self, a: int, b: int) -> None:
        owner = self.owners[b % len(self.owners)]
        if owner.up:
            owner.work(self.now, self.order)

    def do_apply(self, a: int, b: int) -> None:
        owner = self.owners[b % len(self.owners)]
        if owner.up:
            owner.apply(self.now)

    def do_write(self, a: int, b: int) -> None:
        owner = self.owners[b % len(self.owners)]
        if owner.up:
            owner.write(self.now)

    def do_cut(self, a: int, b: int) -> None:
        owner = self.owners[b % len(self.owners)]
        if owner.up:
            owner.cut(a % 3)

    def do_cut_all(self, a: int, b: int) -> None:
        for owner in self.owners:
            if owner.up:
                owner.cut(1 + a % 2)

    def do_cut_while_writing(self, a: int, b: int) -> None:
        self.owners[b % len(self.owners)].cut_while_writing = 1 + a % 2

    def do_start(self, a: int, b: int) -> None:
        owner = self.owners[b % len(self.owners)]
        if not owner.up:
            owner.start(self.now)
            self.do_subscribe(a, owner.index)

    def do_restart(self, a: int, b: int) -> None:
        self.do_cut(a, b)
        self.do_start(a, b)

    def do_unwritable(self, a: int, b: int) -> None:
        owner = self.owners[b % len(self.owners)]
        owner.writable = not owner.writable

    def do_corrupt(self, a: int, b: int) -> None:
        owner = self.owners[b % len(self.owners)]
        if not owner.up and owner.kind != "N":
            owner.durable = owner.visible = (CORRUPT[(a + b) % len(CORRUPT)], UNREADABLE)

    def do_remove(self, a: int, b: int) -> None:
        owner = self.owners[b % len(self.owners)]
        if not owner.up:
            owner.durable = owner.visible = MISSING
            owner.rules.file_removed(self.order)

    # -- the end

    def rest(self) -> None:
        """From now on everything works: senders come to rest, and a person who looks can end every stop."""
        for owner in self.owners:
            owner.writable, owner.cut_while_writing, owner.deaf = True, 0, ()
            if not owner.up:
                owner.start(self.now)
        for _ in range(8):
            self._everything()
            if all(sender.at_rest for sender in self.senders):
                break
        else:
            answered = (sender for sender in self.senders if sender.owners == len(self.owners))
            check(all(sender.at_rest for sender in answered), "a stop is not confirmed though every owner answers")
            self.do_wait(0, WAITS.index(60_000))
            self._everything()
        check(all(sender.at_rest for sender in self.senders), "a sender does not come to rest")
        for index, owner in enumerate(self.owners):
            if owner.latch.latched:
                self._show(0, index, owner.states[-1])
                self.do_reset(0, index)
        self._everything()
        self._everything()
        check(not any(owner.latch.latched for owner in self.owners), "a stop cannot be ended by a person who looked")
        for owner in self.owners:
            check(owner.persisted is not False, "a state is never saved")

    def _everything(self) -> None:
        self.order += 1
        for index in range(len(self.senders)):
            self.do_send(index, 0)
        self.do_all(0, 0)
        for owner in self.owners:
            for _ in range(8):
                owner.write(self.now)
        for wait in (0, STATE_MS, STATE_MS):  # until senders repeat: one state at once, one when it is due
            self.do_wait(0, WAITS.index(wait))
            for index, owner in enumerate(self.owners):
                for who in range(len(self.senders)):
                    self._show(3 + (who - 3) % len(self.senders), index, owner.states[-1])
