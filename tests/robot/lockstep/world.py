"""A whole robot in virtual time: motor owner, manager of scripts, scripts, persons and the network between them.

Every step is possible at any time, and does nothing where it has no meaning, so steps can be left out of a schedule.
"""

from __future__ import annotations

import json
import shutil
import signal
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pebble.config import Config, load
from pebble.extensions.scripts.runs import next_run
from pebble.transports import Message
from tests.robot.lockstep.commands import Commands
from tests.robot.lockstep.manager import Manager
from tests.robot.lockstep.network import Network
from tests.robot.lockstep.owner import Disk, Owner, Wheels
from tests.robot.lockstep.people import Person, announce
from tests.robot.lockstep.processes import Process
from tests.robot.lockstep.rules import WheelRules
from tests.robot.lockstep.scheduler import Scheduler
from tests.robot.lockstep.script_rules import ScriptRules
from tests.robot.lockstep.scripts import Script

STOP_TIMEOUT_S = 1.5
WAITS_S = (0.0, 0.001, 0.005, 0.02, 0.05, 0.1, 0.1, 0.2, 0.3, 0.5, 0.7, 0.76, 1.0, 1.5, 1.99, 2.01, 2.1, 3.0)
_SECONDS = (0.0, 0.05, 0.15, 0.4, 0.8, 1.2, 2.2, 3.0)
_DELAYS = (0.0, 0.003, 0.02, 0.1, 0.3, 0.7, 1.9)
_LATENCIES = (0.0, 0.001, 0.01, 0.1, 0.45)
_VALID_MS = (None, None, None, 600, 100, 5000)

FILES = ("steady", "flood", "pulse", "late", "finish", "fail", "crash",
         "busy", "idle", "steady-needs", "nothing")  # fmt: skip


def configuration(folder: Path, *, on_override: str = "resume") -> Config:
    """A robot of one motor owner, whose files are in ``folder``."""
    services: dict[str, Any] = {
        "serial_mcu_bridge": {"enabled": True, "serial": {"port": str(folder / "tty")}},
        "autonomy_manager": {"enabled": True, "stop_timeout_seconds": STOP_TIMEOUT_S, "on_override": on_override},
    }
    transport = {"kind": "mqtt", "state_dir": str(folder / "state"), "run_dir": str(folder / "run")}
    raw = {"robot": {"id": "goob"}, "transport": transport, "local_mqtt": {"host": "127.0.0.1"}, "services": services}
    path = folder / f"{on_override}.json"
    path.write_text(json.dumps(raw))
    return load(path)


class Folder:
    """The files of a robot, and its parsed configs; worlds one after the other share them."""

    def __init__(self) -> None:
        self._temporary = tempfile.TemporaryDirectory(prefix="pbl")
        self.path = Path(self._temporary.name)
        self.configs = [configuration(self.path, on_override=what) for what in ("resume", "stop")]

    def clear(self) -> None:
        for name in ("state", "run"):
            shutil.rmtree(self.path / name, ignore_errors=True)
        self.configs[0].state_file("autonomy-run").parent.mkdir(parents=True)
        self.configs[0].state_file("autonomy-run").write_text("0000000100\n")


class World:
    """``layout`` chooses the config, and how the schedule ends."""

    def __init__(self, layout: int, folder: Folder) -> None:
        folder.clear()
        self.layout, self.folder = layout, folder
        self.config = folder.configs[layout % 8 == 7]
        self.scheduler = scheduler = Scheduler(10_000.0)
        self.commands = Commands()
        self.network = Network(scheduler, self._arrived, self._published)
        self.wheels = Wheels(scheduler)
        self.disk: Disk = {}
        self.owner = Owner(self.network, self.config, self.disk, self.wheels)
        self.wheel_rules = WheelRules(self.owner, self.commands, scheduler)
        self.manager = Manager(self.network, self.config, self.commands)
        self.script_rules = ScriptRules(self.manager, scheduler)
        self.people = [Person(name, self.network, self.commands) for name in ("anna", "eve")]
        self.by_hand: list[Script] = []
        self._presses = 0
        self.owner.start()
        self.manager.start()
        scheduler.run(0.1)
        announce(self.people[0])
        scheduler.run(2.2)

    def _arrived(self, process: Process, message: Message) -> None:
        if process is self.owner:
            self.wheel_rules.arrived(message)
        elif process is self.manager:
            self.script_rules.arrived(message)

    def _published(self, process: Process, message: Message) -> None:
        if process is self.manager:
            self.script_rules.published(message)

    # -- time

    def do_wait(self, a: int, b: int) -> None:
        self.scheduler.run(WAITS_S[b % len(WAITS_S)])

    # -- persons

    def do_drive(self, a: int, b: int) -> None:
        self._person(a).command(_VALID_MS[b % len(_VALID_MS)])

    def do_steer(self, a: int, b: int) -> None:
        self._person(a).steer_to(_SECONDS[b % 6], b // 6, _VALID_MS[a % len(_VALID_MS)])

    def do_release(self, a: int, b: int) -> None:
        self._person(a).let_go_of_the_stick(final=False)

    def do_halt(self, a: int, b: int) -> None:
        self._person(a).let_go_of_the_stick(final=True)

    def do_tap(self, a: int, b: int) -> None:
        """A zero, and at once another command."""
        self._person(a).let_go_of_the_stick(final=b % 2 == 0)
        self._person(a).command(_VALID_MS[b % len(_VALID_MS)])

    def do_press(self, a: int, b: int) -> None:
        self._presses += 1
        self._person(a).press(f"{self._presses:016x}")

    def do_nameless(self, a: int, b: int) -> None:
        self._person(a).stop(named=False)

    def do_reset(self, a: int, b: int) -> None:
        self._person(a).reset()

    def do_start(self, a: int, b: int) -> None:
        """Mostly a script that drives on."""
        self._person(a).start(FILES[b % len(FILES)] if a > 3 else FILES[b % 3])

    def do_end(self, a: int, b: int) -> None:
        self._person(a).end_script()

    # -- other programs

    def do_pretend(self, a: int, b: int) -> None:
        """A command signed with a number of the past, of the present run, or without a number."""
        run = self.script_rules.newest_run
        self._person(a).pretend((None, run, run - 1, 1, run)[b % 5])

    def do_junk(self, a: int, b: int) -> None:
        self._person(a).junk(b)

    def do_retain(self, a: int, b: int) -> None:
        self._person(a).retain_command(b)

    def do_by_hand(self, a: int, b: int) -> None:
        """A script started from a shell: it takes the robot from the one that runs."""
        run = next_run(self.config, self.script_rules.newest_run)
        self.script_rules.begins(run)
        self.by_hand.append(Script(FILES[b % 2], run, self.network, self.commands, lambda code: None))

    def do_end_by_hand(self, a: int, b: int) -> None:
        for script in self.by_hand:
            script.signal(signal.SIGKILL if b % 2 else signal.SIGTERM)

    # -- faults

    def do_kill(self, a: int, b: int) -> None:
        self._victim(a, lambda process: process.kill(_SECONDS[b % 6] + 0.02))  # a script is not restarted

    def do_freeze(self, a: int, b: int) -> None:
        def freeze(process: Process) -> None:
            process.freeze()
            self.scheduler.after(_SECONDS[b % len(_SECONDS)] + 0.03, process.thaw)

        self._victim(a, freeze)

    def do_gap(self, a: int, b: int) -> None:
        """The whole computer stands still, but not its clock."""
        everybody = [self.owner, self.manager, *self.manager.scripts, *self.by_hand]
        for process in everybody:
            process.freeze()
        self.scheduler.run(_SECONDS[b % len(_SECONDS)])
        for process in everybody:
            process.thaw()

    def do_delay(self, a: int, b: int) -> None:
        self._process(a).delay = _DELAYS[b % len(_DELAYS)]

    def do_slow(self, a: int, b: int) -> None:
        self._process(a).slow_down(_LATENCIES[b % len(_LATENCIES)])

    def do_repeat(self, a: int, b: int) -> None:
        self.network.repeat(self._process(a), 1 + b % 4)

    def do_lose(self, a: int, b: int) -> None:
        connection = self._process(a).connection
        if connection is not None:
            connection.lose(_SECONDS[b % len(_SECONDS)] + 0.01)

    def do_outage(self, a: int, b: int) -> None:
        """The broker restarts; some forget what they have retained."""
        if self.network.era is None:
            return
        self.network.stop(forget=a % 4 == 3)
        self.scheduler.after(_SECONDS[b % len(_SECONDS)] + 0.01, self._find_the_hub)

    def _find_the_hub(self) -> None:
        if self.network.era is None:
            self.network.start()

    # -- parts

    def _person(self, a: int) -> Person:
        return self.people[a % 2]

    def _process(self, a: int) -> Process:
        script = self.manager.newest or self.owner
        return (self.owner, self.manager, script, self.owner, self.manager, script, *self.people)[a % 8]

    def _victim(self, a: int, do: Callable[[Any], None]) -> None:
        process = (self.owner, self.manager, self.manager.newest, self.manager.newest)[a % 4]
        if process is not None and process.alive:
            do(process)
