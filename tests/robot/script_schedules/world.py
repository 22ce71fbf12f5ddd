"""A robot with scripts of its own and of the original's shape, a person, and what fails.

``python -m tests.kit.schedules robot_scripts`` runs hundreds.
"""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import threading
import time
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

from pebble.extensions.operator.client.estop import new_name
from tests.kit.schedules import Engine, Outcome
from tests.kit.stalls import Stalls
from tests.robot.rig import Rig
from tests.robot.script_schedules.alive import Alive
from tests.robot.script_schedules.rules import by_person, by_script, problems
from tests.robot.script_schedules.schedules import ACTIVE_S, FILES, Schedule, Step, make
from tests.robot.stop_schedules.history import History
from tests.robot.stop_schedules.people import Driver
from tests.support import ROOT, until

STOP_TIMEOUT_S = 1.5
_UP_S = 20.0
_MOVES_S = 15.0  # from a start to the first line, on a busy machine
_GONE_S = STOP_TIMEOUT_S + 3.0
_HOLD_S = 2.2
_ANSWER_S = 0.5
_FOLLOW = (ROOT / "tests" / "fakes" / "original_follow.py").read_text()
_STUBBORN = "import signal\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
_BUSY = """from pebble import Robot, run

def main(robot: Robot) -> None:
    for _ in range(10):
        robot.drive(z=-0.3)
        robot.sleep(0.05)
    while True:
        pass

run(main)
"""


class World:
    """A world for many schedules; ``history`` is that of the present one."""

    def __init__(self, transport: str) -> None:
        self.history = History()
        with ExitStack() as opened:
            scripts = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="pbls")))
            _write_scripts(scripts)
            manager = {"enabled": True, "autonomy_root": str(scripts), "stop_timeout_seconds": STOP_TIMEOUT_S}
            self.rig = opened.enter_context(Rig(transport, mirror=transport == "zenoh", autonomy_manager=manager))
            self.person = opened.enter_context(closing(Driver(self.rig.remote.port, "rover", self.history)))
            self.alive = opened.enter_context(closing(Alive(self.rig.folder)))
            self._stalls = opened.enter_context(closing(Stalls()))
            self._timers: list[threading.Timer] = []
            assert until(self._all_listed, _UP_S), self.rig.log.read_text()
            self._opened = opened.pop_all()

    def close(self) -> None:
        self._opened.close()

    def perform(self, schedule: Schedule) -> list[str]:
        """Returns what was violated."""
        self.history = self.person.history = History()
        self.alive.overlaps.clear()
        began = self.history.began
        for step in schedule.steps:
            time.sleep(max(0.0, began + step.at - time.monotonic()))
            self._do(step)
        time.sleep(max(0.0, began + ACTIVE_S - time.monotonic()))
        left = self._rest()
        lines, motors = self.rig.mcu.drives(began), self.rig.mcu.motors(began)
        stalls = [*self._stalls.found, *self.rig.mcu.late(began)]
        return problems(self.history, lines, motors, list(self.alive.overlaps), stalls) + left

    def described(self) -> str:
        """Return what persons did and what the MCU received, in the order of time, and the end of the log."""
        events = [(event.at, f"{event.what} {event.details or ''}") for event in self.history.events()]
        events += [(at, f"    M {wheels}") for at, wheels in self.rig.mcu.drives(self.history.began)]
        return "\n".join([*(f"{at:.3f} {text}" for at, text in sorted(events)), self.rig.log.read_text()[-4000:]])

    # -- what persons do

    def _do(self, step: Step) -> None:
        action = getattr(self, "_" + step.what, None)
        if action is not None:
            action(step)
        else:
            self._fault(step)

    def _start(self, step: Step) -> None:
        options = {"x": 0.0, "z": -0.3} if step.file == "cruise" else {}
        self.history.add("start", file=step.file)
        self._send("autonomy-command", {"action": "start", "file": step.file, "config": options})

    def _end(self, _: Step) -> None:
        self.history.add("end")
        self._send("autonomy-command", {"action": "stop"})

    def _drive(self, _: Step) -> None:
        self.person.drive()

    def _release(self, _: Step) -> None:
        self.person.zero()

    def _lose(self, _: Step) -> None:
        self.person.lose()

    def _halt(self, _: Step) -> None:
        self.person.zero(final=True)

    def _estop(self, _: Step) -> None:
        self.person.lose()
        self.history.add("estop")
        self._send("estop", {"stop": new_name(), "by": "test"})

    def _reset(self, _: Step) -> None:
        state = self.rig.operator.last("outgoing/estop/serial")
        if state is not None and state.payload:
            self._send("estop-reset", {"boot": state.json["boot"], "count": state.json["count"], "by": "test"})

    def _send(self, topic: str, body: dict[str, Any]) -> None:
        self.rig.operator.send(f"incoming/{topic}", body)

    # -- faults

    def _fault(self, step: Step) -> None:
        how, _, which = step.what.partition(" ")
        began = time.monotonic()
        if which == "launcher":
            left = self.rig.kill_launcher()
            self.history.add("manager killed", at=began)
            until(lambda: not any(self.rig.alive(pid) for pid in left), 5)
            self.rig.start(ready=False)
        else:
            self._signal(how, which, step.seconds)
        lasts = step.seconds if how == "freeze" else 0.0
        restart = 0.0 if which == "script" else 1.5
        self.history.add("fault", at=began, which=step.what, until=time.monotonic() + lasts + restart)

    def _signal(self, how: str, which: str, seconds: float) -> None:
        pids = list(self.alive.groups) if which == "script" else [self.rig.processes().get(which, 0)]
        for pid in filter(None, pids):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL if how == "kill" else signal.SIGSTOP)
                if how == "kill" and which == "autonomy_manager":
                    self.history.add("manager killed")
                elif how == "freeze":
                    self._thaw_later(pid, seconds)

    def _thaw_later(self, pid: int, seconds: float) -> None:
        def thaw() -> None:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)

        timer = threading.Timer(seconds, thaw)
        timer.start()
        self._timers.append(timer)

    # -- the end: everything works, and a script can be started and stopped

    def _rest(self) -> list[str]:
        for timer in self._timers:
            timer.join()
        self._timers.clear()
        self.person.lose()
        if not until(self._up, _UP_S):
            return ["the robot does not come back"]
        self._end(Step(0.0, "end"))
        if not until(lambda: not self.alive.groups, _GONE_S):
            return ["a script does not end"]
        time.sleep(_ANSWER_S)  # the state after the last stop may still be on its way
        if not until(self._is_reset, 5.0, step=0.4):
            return ["a stop cannot be reset"]
        if not until(self._is_known, _UP_S, step=0.5):
            return [f"a script is not known: {self._status()}"]
        self._end(Step(0.0, "end"))
        if not until(lambda: not self.alive.groups, _GONE_S):
            return ["a script does not end"]
        time.sleep(_HOLD_S)
        return self._use()

    def _use(self) -> list[str]:
        began = time.monotonic()
        self._start(Step(0.0, "start", FILES[0]))
        if not until(lambda: any(by_script(wheels) for _, wheels in self.rig.mcu.drives(began)), _MOVES_S):
            return [f"a script does not drive: {self._status()}"]
        self.person.drive()
        if not until(lambda: any(by_person(wheels) for _, wheels in self.rig.mcu.drives(began)), _ANSWER_S):
            return ["a person does not drive beside a script"]
        let_go = time.monotonic()
        self.person.zero()
        if not until(lambda: any(by_script(wheels) for _, wheels in self.rig.mcu.drives(let_go)), _HOLD_S + _ANSWER_S):
            return ["a script does not go on after a person has let go"]
        stopped = time.monotonic()
        self.person.zero(final=True)
        if not until(lambda: self.rig.mcu.drives(stopped) and not self.rig.mcu.moving(stopped), _ANSWER_S):
            return ["the wheels are not at rest after a person's stop"]
        if not until(lambda: not self.alive.groups, _GONE_S):
            return ["a script that a person has stopped does not end"]
        shown = until(lambda: self._status().get("error") == "stopped by an operator", 2.0)
        return [] if shown else [f"the status does not say why the script has ended: {self._status()}"]

    def _is_known(self) -> bool:
        """Whether the manager can start a script: one that has just started asks them first what they are."""
        began = time.monotonic()
        self._start(Step(0.0, "start", FILES[0]))
        seen = self.rig.operator
        until(lambda: seen.on("outgoing/autonomy-status", began), 2.0)
        return bool(self._status().get("running"))

    def _status(self) -> dict[str, Any]:
        seen = self.rig.operator.last("outgoing/autonomy-status")
        return {} if seen is None else dict(seen.json)

    def _up(self) -> bool:
        seen, now = self.rig.operator.last("outgoing/online"), time.monotonic()
        running = set(self.rig.processes())
        return seen is not None and now - seen.at < 0.6 and {"autonomy_manager", "serial_mcu_bridge"} <= running

    def _is_reset(self) -> bool:
        state = self.rig.operator.last("outgoing/estop/serial")
        if state is None or not state.payload:
            return False
        if state.json["latched"]:
            self._reset(Step(0.0, "reset"))
        return not state.json["latched"]

    def _all_listed(self) -> bool:
        files = self.rig.operator.last("outgoing/autonomy-files")
        return files is not None and {entry["file"] for entry in files.json["files"]} == set(FILES)


def _write_scripts(root: Path) -> None:
    """The scripts of :data:`FILES`."""
    future = "from __future__ import annotations\n"  # stays in front
    stubborn = _FOLLOW.replace(future, future + _STUBBORN)
    for name, text in {"follow": _FOLLOW, "stubborn": stubborn, "busy": _BUSY}.items():
        (root / name).mkdir()
        (root / name / "run.py").write_text(text)
    shutil.copytree(ROOT / "tests" / "robot" / "scripts" / "cruise", root / "cruise")


ENGINE = Engine(
    draw=lambda kind, seed, number: make(kind, seed + number),
    world=lambda kind: closing(World(kind)),
    perform=lambda world, schedule: Outcome(world.perform(schedule), log=world.described),
    kinds=("zenoh", "mqtt"),
    schedules=200,
    per_world=20,
    repeats=False,
)
