"""Two robots of a LAN, which their operators reach by a gateway: Goob follows Fred, also without the operators' broker.

Both are clients of two hubs: at one they hear each other, at the other a gateway fetches them for that broker.
Every step is judged by what the robots' MCUs did, and by what arrived on the robots' own transports.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

from rich.console import Console

from pebble.client.estop import StopSender, new_name
from pebble.client.estop_states import Reset
from pebble.client.page.packages import require_packages
from pebble.contract import AUTONOMY_FILES, AUTONOMY_STATUS, DRIVE, NEIGHBOUR_VALUE, WHEEL_ODOMETRY, codec
from pebble.contract.payloads import Drive
from pebble.demo.brokers import BrokerKind, best_kind
from pebble.demo.main import ending_on_signals, print_line, usual_or_free
from pebble.demo.page_socket import PageSocket
from pebble.errors import PebbleError
from pebble.rig.processes import HOST, OPERATORS, Program, free_port, python
from pebble.rig.robot import Robot
from pebble.rig.testbed import Testbed
from pebble.runtime.robot_estop import RobotEstop
from pebble.transports import Message, MqttSettings, QoS, Transport, ZenohSettings, create

LONGEST_S = 180.0  # for all steps, unless told otherwise; a third of it on two busy processors
GATEWAY = "gate-1"
SCRIPTS = FOLLOW, ODOMETRY = "follow", WHEEL_ODOMETRY.metric
_BY = "the demo's person at the LAN"
_STEP_S, _DRIVE_S, _GESTURE_S, _AGAIN_S = 0.02, 0.05, 2.0, 5.0
_FOLLOWED_MM, _DRIVEN_MM, _STOP_S = 80.0, 60.0, 1.0
_POWER = 0.15
#: What the config of each has besides the hubs; ids as in its name.
_NEIGHBOURS: dict[str, dict[str, Any]] = {"goob": {"listens": {"fred": [ODOMETRY]}}, "fred": {"shares": [ODOMETRY]}}
_KINDS = {"goob": "zenoh", "fred": "mqtt"}


class LanRobot(Robot):
    """Its operators are at the hub ``site``; it receives others at the hub ``lan``."""

    runs_on, stop_s = "Linux, SAMD21", 0.85

    def __init__(self, running: Fleet, name: str) -> None:
        neighbours = {"lan": {"connect": [running.hubs["lan"]]}, **_NEIGHBOURS[name]}
        services = {
            "mqtt_bridge": {"remote": {"kind": "zenoh", "connect": [running.hubs["site"]]}},
            "serial_mcu_bridge": {"serial": {"baud": 460_800}, "telemetry": {"publish_touch_sensors": True}},
            "neighbours": neighbours,
        }
        if name == "goob":
            services["autonomy_manager"] = {"autonomy_root": str(running.scripts)}
        place = {"name": name, "folder": running.folder / name, "services": services}
        super().__init__(running, _KINDS[name], (HOST, running.broker_port), **place)  # type: ignore[arg-type]
        self.local_port = running.local_broker.port if self.kind == "mqtt" else None
        self.arrived: list[bytes] = []

    def bring_up(self, ending: threading.Event) -> None:
        self.prepare(ending)
        self.start(self.name, python("pebble.cli", "up", self.config))

    def measure(self) -> None:
        """Run its odometry by hand: its manager would end it, as any script, when a driver's gesture breaks off."""
        file = files("pebble") / "scripts" / ODOMETRY / "run.py"
        self.start(f"{self.name}'s odometry", [sys.executable, str(file), "--config", str(self.config)])

    def _start_motors(self) -> Program:
        return self._start_board(self.name, self.port, self._trace, "--report", each=self._collect)

    def own_transport(self, topic: str) -> Transport:
        """A client of the robot's own transport, which notes in ``arrived`` what comes there on this topic."""
        mqtt = MqttSettings(host=HOST, port=self.local_port or 0)
        settings = ZenohSettings(run_dir=self.run_dir, client=True) if self.kind == "zenoh" else mqtt
        transport = create(self.kind, "witness", settings).open(timeout=0.0)
        transport.subscribe(topic, lambda message: self.arrived.append(message.payload), direct=True)
        return transport

    def where(self) -> tuple[float, float]:
        if not self.mcu_reports:
            return 0.0, 0.0
        pose = self.mcu_reports[-1].board.pose
        return pose.x_mm, pose.y_mm

    def moves(self) -> bool:
        motors = [one.motors for one in self.entries() if one.motors is not None]
        return bool(motors) and motors[-1] != (0.0, 0.0)

    def stopped_after(self, since: float) -> float | None:
        """Seconds until its motors were switched off for good; None: they run."""
        changed = [one.ns / 1e9 for one in self.entries() if one.motors is not None and one.ns >= since * 1e9]
        return None if self.moves() or not changed else changed[-1] - since


class Fleet(Testbed):
    """The processes: a broker, two hubs, a gateway between the broker and one of them, the page, two robots."""

    def __init__(self, ending: threading.Event) -> None:
        super().__init__(ending, ())
        self.hubs = {name: f"tcp/{HOST}:{free_port()}" for name in ("lan", "site")}
        self.scripts = self.folder / "scripts"  # only those of the demo: each that is listed is started once
        for name in SCRIPTS:
            shutil.copytree(str(files("pebble") / "scripts" / name), self.scripts / name)

    def start_network(self, kind: BrokerKind) -> None:
        self._kind = kind
        self.start_brokers(kind.program)
        for name, endpoint in self.hubs.items():
            self._tool("hub", f"hub-{name}", {"listen": [endpoint], "run_dir": str(self.folder / f"run-{name}")})
        gateway = {"id": GATEWAY, "hub": {"connect": [self.hubs["site"]]}}
        self._tool("gateway", GATEWAY, gateway | {"mqtt": {"host": HOST, "port": self.broker_port}})

    def start_walkers(self) -> dict[str, LanRobot]:
        walkers = {name: LanRobot(self, name) for name in _KINDS}
        for one in walkers.values():
            one.bring_up(self._ending)
        return walkers

    def stop_broker(self) -> None:
        self.end(self.remote_broker)

    def start_broker_again(self) -> None:
        self.remote_broker = self.broker("remote-broker", program=self._kind.program, port=self.broker_port)
        self.remote_broker.wait(self._ending)

    def _tool(self, command: str, name: str, contents: dict[str, Any]) -> None:
        """``pebble hub FILE`` or ``pebble gateway FILE``."""
        file = self.folder / f"{name}.json"
        file.write_text(json.dumps(contents, indent=1), encoding="utf-8")
        self.add(Program(name, python("pebble.cli", command, file), self.folder / f"{name}.log"), OPERATORS)


class Person:
    """Who drives at the hub of the site, without the operators' broker. Each drive command differs from all others."""

    def __init__(self, run_dir: Path, hub: str) -> None:
        settings = ZenohSettings(run_dir=run_dir, connect=(hub,), client=True)
        self.transport = create("zenoh", "person", settings)
        self.sent: set[float] = set()
        self._estops: dict[str, RobotEstop] = {}
        self._scripts: dict[str, Any] = {}  # by topic

    def watch(self, base: str) -> None:
        self._estops[base] = RobotEstop(base)
        self._estops[base].subscribe(self.transport)
        for channel in (AUTONOMY_FILES, AUTONOMY_STATUS):
            self.transport.subscribe(channel.topic(base), self._take, direct=True)

    def knows_scripts(self, base: str) -> bool:
        """Whether the robot has listed all of them."""
        return len(self._scripts.get(AUTONOMY_FILES.topic(base), {}).get("files", ())) == len(SCRIPTS)

    def runs(self, base: str, file: str) -> bool:
        found = self._scripts.get(AUTONOMY_STATUS.topic(base), {})
        return found.get("running") is True and found.get("file") == file

    def drive(self, base: str) -> None:
        z = round(_POWER + 0.01 + len(self.sent) / 1e5, 5)  # nor is it one of the page's
        self.sent.add(z)
        self._publish(Message(DRIVE.topic(base), codec.encode(DRIVE, Drive(z=z)), QoS.DELIVERED))

    def stop(self, base: str) -> StopSender:
        return StopSender(new_name(), by=_BY, why="part of the demo", now=time.monotonic(), robots=[base])

    def counts(self, base: str) -> int:
        """How many stops its motor owners have counted."""
        return sum(state.count for state in self._estops[base].states.values())

    def latched(self, base: str) -> bool:
        return bool(self._estops[base].latched)

    def reset(self, base: str) -> None:
        for message in Reset(self._estops[base], _BY).messages():
            self._publish(message)

    def send(self, sender: StopSender) -> None:
        for message in sender.tick(time.monotonic()):
            self._publish(message)

    def _take(self, message: Message) -> None:
        self._scripts[message.topic] = json.loads(message.payload or b"{}")

    def _publish(self, message: Message) -> None:
        self.transport.publish(message.topic, message.payload, qos=message.qos, urgent=message.topic.endswith("estop"))


class Story:
    """The steps. ``until`` waits for what a step is about, and prints that it was seen."""

    def __init__(self, fleet: Fleet, page: PageSocket, console: Console, ending: threading.Event, end: float) -> None:
        self._fleet, self._page, self._console = fleet, page, console
        self._ending, self._end, self._began = ending, end, time.monotonic()
        self._gesture_ends = self._start_due = 0.0
        self._robots = fleet.start_walkers()
        self._goob, self._fred = self._robots["goob"], self._robots["fred"]
        self._person = Person(fleet.folder / "run-person", fleet.hubs["site"])

    def play(self) -> None:
        """Raises PebbleError with what was not seen, in time or at all."""
        goob, fred, person = self._goob, self._fred, self._person
        witnesses = [
            goob.own_transport(NEIGHBOUR_VALUE.topic(goob.base, robot="fred", metric=ODOMETRY)),
            fred.own_transport(DRIVE.topic(fred.base)),
        ]
        person.transport.open(timeout=0.0)
        try:
            self.until("the page shows goob and fred, fetched by the gateway", lambda: self._online(True))
            self._start_scripts()
            self._page_drives("the page drives fred, and goob follows")
            self._fleet.stop_broker()
            self.until("the operators' broker is stopped: the page receives no robot", lambda: self._online(False))
            self._person_drives("a person at the LAN drives fred, and goob follows without the broker")
            self._stop(goob, "goob")
            self._stop(fred, "fred")
            self._fleet.start_broker_again()
            self.until("the broker is back: the page shows both again", lambda: self._online(True))
            self._start_follow()  # the stop has ended it
            self._page_drives("the page drives fred again, and goob follows")
            self._nothing_twice()
        finally:
            for transport in (*witnesses, person.transport):
                transport.close()

    def until(self, line: str, seen: Callable[[], bool], each: Callable[[], object] = lambda: None) -> None:
        due = 0.0
        while not seen():
            if problems := self._fleet.unexpected_exits():
                raise PebbleError("; ".join(problems))
            if self._ending.wait(_STEP_S) or time.monotonic() > self._end:
                raise PebbleError(f"not seen: {line or 'what comes before the next step'}")
            if time.monotonic() >= due:
                each()
                due = time.monotonic() + _DRIVE_S
        if line:
            print_line(self._console, f"{time.monotonic() - self._began:5.1f} s  {line}")

    def _online(self, wanted: bool) -> bool:
        found = [self._page.value(one.base, "web/liveness", "online") is True for one in self._robots.values()]
        return found == [wanted] * len(found)

    def _start_scripts(self) -> None:
        goob = self._goob
        for one in self._robots.values():
            self._person.watch(one.base)
        self.until("goob's scripts are listed", lambda: self._person.knows_scripts(goob.base))
        self._fred.measure()
        self._start_follow()
        self.until("goob receives fred's odometry at the hub of the LAN", lambda: bool(goob.arrived))

    def _start_follow(self) -> None:
        """Asked for again where it was refused: after the zero that comes with each stop no script starts for 2 s."""
        self._start_due = 0.0
        self.until("follow runs at goob", lambda: self._person.runs(self._goob.base, FOLLOW), self._start_when_due)

    def _start_when_due(self) -> None:
        if time.monotonic() > self._start_due:
            self._start_due = time.monotonic() + _AGAIN_S
            self._page.start_script(self._goob.base, FOLLOW)

    def _page_drives(self, line: str) -> None:
        base = self._fred.base
        self._page.take(base)
        self.until("the page has control of fred", lambda: self._page.holds(base))
        self._follow_while(line, self._page_drives_on)
        self._page.let_go(base)
        self.until("", lambda: not self._page.holds(base))

    def _page_drives_on(self) -> None:
        """The page drives in several gestures: on an overloaded machine its server ends one that comes late."""
        if time.monotonic() > self._gesture_ends:
            self._gesture_ends = time.monotonic() + _GESTURE_S
            self._page.begin_gesture()
        self._page.drive(self._fred.base, _POWER)

    def _person_drives(self, line: str) -> None:
        self._follow_while(line, lambda: self._person.drive(self._fred.base))

    def _follow_while(self, line: str, drive: Callable[[], object]) -> None:
        goob, fred = self._goob.where(), self._fred.where()
        self.until(
            line,
            lambda: (
                math.dist(self._goob.where(), goob) > _FOLLOWED_MM and math.dist(self._fred.where(), fred) > _DRIVEN_MM
            ),
            drive,
        )

    def _stop(self, robot: LanRobot, name: str) -> None:
        """It is stopped while Fred is driven, then reset; it counts one stop."""
        base, person = robot.base, self._person
        self.until("", robot.moves, lambda: person.drive(self._fred.base))
        before, pressed, sender = person.counts(base), time.monotonic(), person.stop(base)
        person.send(sender)
        self.until(
            f"a stop of {name} is confirmed at the LAN",
            lambda: person.latched(base) and robot.stopped_after(pressed) is not None,
            lambda: person.drive(self._fred.base),
        )
        took = robot.stopped_after(pressed) or 0.0
        if took > _STOP_S or person.counts(base) != before + 1:
            raise PebbleError(f"{name} stopped after {took:.2f} s, and counted {person.counts(base) - before} stops")
        person.reset(base)
        self.until(f"{name} stood after {took:.2f} s; it is reset", lambda: not person.latched(base))

    def _nothing_twice(self) -> None:
        sent = self._person.sent
        drives = [one for one in self._fred.arrived if one.strip() and json.loads(one)["z"] in sent]  # no probes
        for what, arrived in (("commands of the person at fred", drives), ("odometry at goob", self._goob.arrived)):
            twice = sum(count - 1 for count in Counter(arrived).values())
            if twice or not arrived:
                raise PebbleError(f"{what}: {len(arrived)} arrived, {twice} of them twice")
            self.until(f"{what}: {len(arrived)} arrived, none twice", lambda: True)


def run(seconds: float | None = None, *, broker: BrokerKind | None = None, console: Console | None = None) -> int:
    """Play it; 0 if every step was seen, within ``seconds``. Without these it goes on until Ctrl-C.

    Every process ends with it; the folder of logs stays only after a failure. Raises PebbleError without a broker.
    """
    require_packages()
    console, kind, longest = console or Console(), broker or best_kind(), seconds or LONGEST_S
    with ending_on_signals() as ending, Fleet(ending) as fleet:
        print_line(
            console, f"The operators' broker ({kind}); two hubs, lan and site; a gateway from site to the broker."
        )
        fleet.start_network(kind)
        url = usual_or_free(fleet, ending).url
        print_line(console, f"See and drive them in a browser: {url}")
        print_line(console, f"The steps take half a minute, at most {longest:.0f} s; Ctrl-C ends them.")
        page = PageSocket(url)
        try:
            Story(fleet, page, console, ending, time.monotonic() + longest).play()
        except PebbleError as error:
            fleet.keep = not ending.is_set()
            if ending.is_set():
                print_line(console, "Ended before every step was seen.")
                return int(seconds is not None)
            print_line(console, f"Failed: {error}. Logs, configs and traces: {fleet.folder}")
            return 1
        finally:
            page.close()
        fleet.keep = False
        if seconds is None:
            print_line(console, f"Every step was seen. The robots are yours: {url}; Ctrl-C ends it.")
            ending.wait()
        else:
            print_line(console, "Every step was seen; the demo ends.")
    return 0
