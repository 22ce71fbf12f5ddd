"""Random schedules of a whole robot: two people who take control of it from each other, its scripts, stops and faults.

``python -m tests.kit.schedules robot`` runs hundreds. The robot refuses strangers, so that each line of a person had a
key.
"""

from __future__ import annotations

import os
import secrets
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from itertools import groupby
from pathlib import Path
from typing import Any

from pebble.contract import ESTOP, ESTOP_STATE, codec
from pebble.contract.payloads import EstopState
from pebble.extensions.operator.client.estop import StopSender, new_name
from pebble.transports import Message
from tests.kit.schedules import Engine, Result, Steps
from tests.kit.stalls import Stalls
from tests.robot.operator import Operator, ReceivedMessage
from tests.robot.rig import BASE, Rig, descendants, restore, saved_by
from tests.robot.whole_rules import Alive, History, Seen, by_script
from tests.support import WAIT_S, Broker, gone, until

STATE, STOPPED = "outgoing/control/serial", "outgoing/estop/serial"
SPEEDS = {"ann": 0.3, "otto": 0.5}
FILES = ("cruise", "cruise", "busy", "stubborn")
_STOP_TIMEOUT_S = 1.5
_PERIOD_S = 0.06
_HOLD_S = 2.2  # a person's command holds a script
#: Faults of what the watcher hears the robot through.
_DEAFENING = (  # a killed launcher takes hub and mirror along, as a power cut does
    *("kill mqtt_mirror", "freeze mqtt_mirror", "kill zenoh_hub", "freeze zenoh_hub"),
    *("kill launcher", "kill power", "a broker is away"),
)
_WAITS_S = (0.02, 0.05, 0.1, 0.1, 0.2, 0.3, 0.5, 1.0)
_FROZEN_S = (0.1, 0.3, 0.5, 1.0, 1.5, 2.5)
_FAULTS = (
    "serial_mcu_bridge",
    "mqtt_bridge",
    "script",
    "zenoh_hub",
    "mqtt_mirror",
    "autonomy_manager",
    "launcher",
    "power",
)
_WEIGHTS = {
    "hold": 4, "take": 4, "release": 2, "drive": 6, "let_go": 3, "lose": 1, "stop": 3, "look": 2, "reset": 3,
    "start": 4, "end": 2, "kill": 3, "freeze": 2, "break": 4, "restore_broker": 1, "plant_stop": 1,
}  # fmt: skip


class Person:
    """Repeats a request for control, a drive command and stops, each while it is wanted; a key is used for ever.

    ``heard``: what its robot has published.
    """

    def __init__(self, name: str, operator: Operator, heard: list[ReceivedMessage]) -> None:
        self.name, self.id, self.operator, self._heard = name, secrets.token_hex(4), operator, heard
        self.key = ""
        self.wants = self.drives = False
        self.stops: list[StopSender] = []
        self._heard_up_to: dict[str, int] = {}  # by stop
        self._changed, self._ended = threading.Event(), False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._ended = True
        self._changed.set()
        self._thread.join()
        self.operator.close()

    def send(self, metric: str, body: Any) -> None:
        self.operator.send(f"incoming/{metric}", body)

    def request(self, topic: str = "control", want: str = "hold") -> None:
        self.wants = want == "hold"
        self._request(topic, want)

    def _request(self, topic: str, want: str) -> None:
        self.send(topic, {"want": want, "id": self.id, "by": self.name, "device": "desk"})

    def drive(self, speed: float) -> None:
        self.send("drive-values", {"x": 0, "z": speed, "key": self.key})

    def stop(self, name: str) -> None:
        """Send an emergency stop until it is confirmed."""
        self.stops = [*self.stops, StopSender(name, by=self.name, why="", now=time.monotonic(), robots=[BASE])]

    def has_control(self) -> bool:
        """True if it has control; notes the key."""
        seen = self.operator.last(STATE)
        if seen is None or seen.json["id"] != self.id:
            return False
        self.key = seen.json["key"]
        return True

    def _run(self) -> None:
        asked = 0.0
        while not self._ended:
            self.has_control()
            for stop in self.stops:
                self._repeat(stop)
            if self.wants and time.monotonic() > asked + 1.0:
                asked = time.monotonic()
                self._request("control", "hold")
            if self.drives and self.key:
                self.drive(SPEEDS[self.name])
            self._changed.wait(_PERIOD_S)

    def _repeat(self, stop: StopSender) -> None:
        known, first = len(self._heard), self._heard_up_to.get(stop.order.name, 0)
        self._heard_up_to[stop.order.name] = known
        for seen in self._heard[first:known]:
            stop.receive(Message(seen.topic, seen.payload, retain=seen.retain or not first), time.monotonic())
        for message in stop.tick(time.monotonic()):
            if message.topic == ESTOP.topic(BASE):
                self.send("estop", message.payload)


class World:
    """A robot, its brokers and two people; ``history`` is that of the present schedule."""

    def __init__(self, kind: str) -> None:
        self.history = History()
        manager = {"stop_timeout_seconds": _STOP_TIMEOUT_S}
        options: dict[str, Any] = {"mirror": kind == "zenoh", "scripts": tuple(set(FILES))}
        with ExitStack() as opened:
            folder = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="pbls")))
            self._remote = Broker(folder, persistence=True, autosave=False)
            options |= {"autonomy_manager": manager, "top": {"security": {"strangers": "refuse"}}}
            self.rig = opened.enter_context(Rig(kind, remote=self._remote, **options))
            heard = self.rig.operator.seen
            people = [Person(name, Operator(self._remote.port, BASE, STATE), heard) for name in SPEEDS]
            self.people = [opened.enter_context(closing(person)) for person in people]
            local = (self.rig.local or self.rig.remote).port
            self.watcher = opened.enter_context(closing(Operator(local, BASE, "outgoing/+/serial")))
            assert until(lambda: self.watcher.last(STATE) is not None), "nothing is mirrored"
            self.alive = opened.enter_context(closing(Alive(self.rig.folder)))
            self._stalls = opened.enter_context(closing(Stalls()))
            self._timers: list[threading.Timer] = []
            self._planted: set[str] = set()
            self._looked: EstopState | None = None
            self._older: dict[Path, bytes] = {}
            assert until(self.rig.lists_scripts, 60), self.rig.log.read_text()
            self._opened = opened.pop_all()

    def close(self) -> None:
        self._opened.close()

    def perform(self, schedule: Steps) -> Result:
        self.history = History()
        self.alive.overlaps.clear()
        self._looked, self._older = None, {}
        for person in self.people:
            person.stops = []
        began = self.history.began
        for action, a, b in schedule[1]:
            getattr(self, "do_" + action)(self.people[a % 2], b)
            time.sleep(_WAITS_S[b % len(_WAITS_S)])
        left = self._rest()
        lines, motors = self.rig.mcu.drives(began), self.rig.mcu.motors(began)
        states = [
            (seen.at, _state(seen)) for seen in self.watcher.on(STOPPED, began) if seen.payload and not seen.retain
        ]
        seen = Seen(self.history, lines, motors, states, list(self.alive.overlaps), SPEEDS, self._planted)
        found = seen.problems([*self._stalls.found, *self.rig.mcu.late(began)])
        counts = {"lines": len(lines), "stops": len(self.history.events("estop"))}
        problems = [*found, *self._out_of_turn(began), *left]
        return Result(problems, counts, self._log(began) if problems else "")

    # -- what people do; what is short or long with the number ``b``

    def do_hold(self, person: Person, _: int) -> None:
        self._note("hold", person)
        person.request()

    def do_take(self, person: Person, _: int) -> None:
        self._note("take", person)
        person.request("control/take")

    def do_release(self, person: Person, _: int) -> None:
        self._note("release", person)
        person.request(want="release")

    def do_drive(self, person: Person, _: int) -> None:
        self._note("drives", person)
        person.drives = True

    def do_let_go(self, person: Person, b: int) -> None:
        person.drives = False
        self._note("zero", person, final=b % 3 == 0)
        person.send("drive-values", {"x": 0, "z": 0, **({"valid_ms": 0} if b % 3 == 0 else {})})

    def do_lose(self, person: Person, _: int) -> None:
        self._note("lose", person)
        person.drives = person.wants = False

    def do_stop(self, person: Person, b: int) -> None:
        """Most people drive on: what is latched must not move. A quarter of all stops is sent once, at the robot."""
        if b % 3 == 0:
            for driver in self.people:
                driver.drives = False
        name = new_name()
        self._note("estop", person, name=name)
        if b % 4 == 3:
            self.watcher.send("incoming/estop", {"stop": name, "by": person.name})
        else:
            person.stop(name)

    def do_look(self, _: Person, __: int) -> None:
        """What a later reset may be made of."""
        seen = self.watcher.last(STOPPED)
        self._looked = None if seen is None or not seen.payload else _state(seen)

    def do_reset(self, person: Person, b: int) -> None:
        if b % 3 or self._looked is None:
            self.do_look(person, b)
        shown = self._looked
        if shown is not None:
            self._note("reset", person, shown=shown)
            person.send("estop-reset", {"boot": shown.boot, "count": shown.count, "by": person.name})

    def do_start(self, person: Person, b: int) -> None:
        self._note("start", person)
        file = FILES[b % len(FILES)]
        options = {"x": 0.0, "z": -0.3} if file == "cruise" else {}
        person.send("autonomy-command", {"action": "start", "file": file, "config": options})

    def do_end(self, person: Person, _: int) -> None:
        self._note("end", person)
        self._end(person)

    def _end(self, person: Person) -> None:
        person.send("autonomy-command", {"action": "stop"})

    # -- faults

    def do_kill(self, _: Person, b: int) -> None:
        which = _FAULTS[b % len(_FAULTS)]
        with self._fault(f"kill {which}", 1.5):
            if which in ("autonomy_manager", "launcher", "power"):
                self.history.add("manager killed")
            if which in ("launcher", "power"):
                self._start_again(self._power_cut() if which == "power" else self.rig.kill_launcher())
            else:
                _send(self._pids(which), signal.SIGKILL)

    def _power_cut(self) -> list[int]:
        """Every process of the robot ends at the same time; what is on disk stays."""
        launcher = self.rig.launcher_pid
        _send([launcher], signal.SIGSTOP)
        pids = descendants(launcher)
        _send(pids, signal.SIGKILL)
        self.rig.kill_launcher()
        return pids

    def _start_again(self, left: list[int]) -> None:
        until(lambda: all(map(gone, left)), 5)
        self.rig.start(ready=False)

    def do_freeze(self, _: Person, b: int) -> None:
        which, seconds = _FAULTS[b % 5], _FROZEN_S[b % len(_FROZEN_S)]
        with self._fault(f"freeze {which}", seconds + 1.5 * (which != "script")):
            pids = self._pids(which)
            _send(pids, signal.SIGSTOP)
            self._timers.append(threading.Timer(seconds, _send, (pids, signal.SIGCONT)))
            self._timers[-1].start()

    def _pids(self, which: str) -> list[int]:
        if which == "script":
            return list(self.alive.groups)
        return [pid for name, pid in self.rig.processes().items() if name == which]

    def do_break(self, _: Person, b: int) -> None:
        """The way to the operators, or a broker, fails for a while."""
        uplink, broker = self.rig.uplink, self.rig.local if b & 4 and self.rig.local is not None else self.rig.remote
        which, begin, end, after = (
            ("the uplink is silent", uplink.blackhole, uplink.resume, 0.0),
            ("the uplink is cut", uplink.cut, uplink.mend, 1.0),
            ("a broker is away", broker.kill, broker.start, 1.5),
            ("a broker is frozen", broker.freeze, broker.thaw, 1.5),
        )[b >> 3 & 3]
        with self._fault(which, after):
            begin()
            time.sleep(_FROZEN_S[b % len(_FROZEN_S)])
            end()

    def do_restore_broker(self, _: Person, __: int) -> None:
        """The first time its memory is saved; later it is killed, and has its older memory."""
        if not self._older:
            self._older = saved_by(self._remote)
            return
        with self._fault("a broker of before", 1.5):
            self._remote.kill()
            restore(self._older)
            self._remote.start()

    def do_plant_stop(self, _: Person, b: int) -> None:
        """A stop reaches the broker while the robot is away, retained: it receives only the copy."""
        operator = self.rig.operator
        if self.rig.local is None:
            return  # its programs are not away from their own
        if not until(lambda: operator.is_connected):
            return  # what it sent would arrive later, live
        with self._fault("the uplink is cut for a retained stop", 1.0):
            self.rig.uplink.cut()
            name = new_name()
            operator.send("incoming/estop", {"stop": name, "by": "old"}, retain=True).wait_for_publish(WAIT_S)
            self._planted.add(name)
            time.sleep(0.1 + _WAITS_S[b % 8])
            self.rig.uplink.mend()

    @contextmanager
    def _fault(self, which: str, after: float = 0.0) -> Iterator[None]:
        began = time.monotonic()
        yield
        self.history.add("fault", at=began, which=which, until=time.monotonic() + after)

    def _note(self, what: str, person: Person, **details: Any) -> None:
        self.history.add(what, by=person.name, **details)

    # -- rules

    def _holders(self, since: float) -> list[str]:
        """Return who had control, in turn, as the robot has published it on its own side."""
        seen = [one for one in self.watcher.on(STATE) if one.payload]
        before = [one for one in seen if one.at < since][:-1]  # the last one of them counts
        return [name for name, _ in groupby(one.json["by"] for one in seen[len(before) :])]

    def _out_of_turn(self, since: float) -> Iterator[str]:
        """Find a line of a sender who had no control then, by order alone: the clocks of two processes differ.

        Lines of the time in which the watcher hears nothing of the robot are not judged.
        """
        turns = iter(self._holders(since))
        speeds = {(speed, speed): name for name, speed in SPEEDS.items()}
        faults = [fault for fault in self.history.events("fault") if fault.details["which"] in _DEAFENING]
        driven = [
            speeds[wheels]
            for at, wheels in self.rig.mcu.drives(since)
            if wheels in speeds and not any(fault.at <= at < fault.details["until"] for fault in faults)
        ]
        for name, _ in groupby(driven):
            if name not in turns:
                yield f"the wheels obey {name} out of turn: {driven[-5:]}, control of {self._holders(since)}"
                return

    # -- the end: stops are confirmed, each of the two gets control and drives alone, and a script can be used

    def _rest(self) -> list[str]:
        for person in self.people:
            person.wants = person.drives = False
        for timer in self._timers:
            timer.join()
        for holds, step, problem in (
            (self._up, 0.003, "the robot does not come back"),
            (self._are_confirmed, 0.003, "a stop is not confirmed"),
            (self._ended, 0.5, "a script does not end"),
            (self._is_reset, 0.4, "a stop cannot be reset"),
        ):
            if not until(holds, step=step):
                return [problem]
        for person in self.people:
            if problem := self._drives(person):
                return [problem]
            person.request(want="release")
        zero = time.monotonic()
        self.do_let_go(self.people[0], 0)
        if not until(lambda: self.rig.mcu.drives(zero) and not self.rig.mcu.moving(zero)):
            return ["a zero does not stop the wheels"]
        time.sleep(_HOLD_S)
        return self._use_script(self.people[0])

    def _drives(self, person: Person, *, zero: bool = True) -> str:
        """Return why not; empty: it gets control and drives, while the other one sends keys of before.

        ``zero``: after a reset one lets go first; while a script drives, that would end it.
        """
        person.request("control/take")
        if not until(person.has_control):
            return f"{person.name} does not get control"
        if zero:
            person.drive(0)
        self._note("drives", person)
        began, wheels = time.monotonic(), (SPEEDS[person.name],) * 2
        for one in self.people:
            one.drives = True
        obeyed = until(lambda: wheels in [driven for _, driven in self.rig.mcu.drives(began)])
        for one in self.people:
            one.drives = False
        return "" if obeyed else f"{person.name} has control, and the wheels do not obey"

    def _use_script(self, person: Person) -> list[str]:
        began = time.monotonic()
        for _ in range(3):  # a start that a busy machine has held up is dropped
            self.do_start(person, 0)
            if drives := until(lambda: self._script_moves(began), 10.0):
                break
        if not drives:
            return [f"a script does not drive: {self.rig.script()}"]
        if problem := self._drives(person, zero=False):
            return [problem]
        released = time.monotonic()
        person.drive(0)  # with its key: any other zero ends the script
        person.request(want="release")
        if not until(lambda: self._script_moves(released)):
            return ["a script does not go on after a person has let go"]
        stopped = time.monotonic()
        self.do_let_go(person, 0)
        if not until(lambda: self.rig.mcu.drives(stopped) and not self.rig.mcu.moving(stopped)):
            return ["the wheels are not at rest after a person's stop"]
        if not until(lambda: not self.alive.groups):
            return ["a script that a person has stopped does not end"]
        shown = until(lambda: self.rig.script().get("error") == "stopped by an operator")
        return [] if shown else [f"the status does not say why the script has ended: {self.rig.script()}"]

    def _script_moves(self, since: float) -> bool:
        return any(by_script(wheels) for _, wheels in self.rig.mcu.drives(since))

    def _are_confirmed(self) -> bool:
        if not all(stop.confirmed for person in self.people for stop in person.stops):
            return False
        for person in self.people:
            person.stops = []
        return True

    def _ended(self) -> bool:
        """Ask again: on a busy machine a broker does not answer for two seconds, and what was sent is lost."""
        self._end(self.people[0])
        return not self.alive.groups

    def _up(self) -> bool:
        seen, now = self.rig.operator.last("outgoing/online"), time.monotonic()
        running = set(self.rig.processes())
        return seen is not None and now - seen.at < 0.6 and {"autonomy_manager", *_FAULTS[:2]} <= running

    def _is_reset(self) -> bool:
        """True if the motor owner answers a reset with a state that is not latched; an older state may be stale."""
        asked = time.monotonic()
        self.do_reset(self.people[0], 1)
        if not until(lambda: self.watcher.on(STOPPED, asked), 1.0):
            return False
        state = self.watcher.on(STOPPED, asked)[-1]
        return bool(state.payload) and not state.json["latched"]

    def _log(self, since: float) -> str:
        events = [(event.at, f"{event.what} {event.details or ''}") for event in self.history.events()]
        events += [(at, f"    M {wheels}") for at, wheels in self.rig.mcu.drives(since)]
        events += [
            (one.at, f"  {name} {one.payload!r}") for name in (STATE, STOPPED) for one in self.watcher.on(name, since)
        ]
        lines = [f"{at:.3f} {text}" for at, text in sorted(events, key=lambda event: event[0])]
        return "\n".join([*lines, self.rig.log.read_text()[-3000:]])


def _send(pids: list[int], number: signal.Signals) -> None:
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, number)


def _state(seen: ReceivedMessage) -> EstopState:
    state: EstopState = codec.decode(ESTOP_STATE, seen.payload)
    return state


_BEGIN = (("start", 0, None), ("take", 0, None), ("drive", 0, None))
ENGINE = Engine(
    mixes=(_WEIGHTS,),
    length=24,
    begin=_BEGIN,
    world=lambda kind: closing(World(kind)),
    perform=lambda world, schedule: world.perform(schedule),
    kinds=("zenoh", "mqtt", "single"),
    schedules=400,
    per_world=20,
    repeats=False,
)
