"""The manager of scripts: the real service, with simulated processes instead of real ones."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

from pebble.config import Config
from pebble.extensions.scripts.runs import RUN
from pebble.services.autonomy_manager.child import Launch
from pebble.services.autonomy_manager.script import Dependency
from pebble.services.autonomy_manager.script import Script as Described
from pebble.services.autonomy_manager.service import AutonomyManager
from tests.robot.lockstep.commands import Commands
from tests.robot.lockstep.network import Connection, Network
from tests.robot.lockstep.processes import ServiceProcess
from tests.robot.lockstep.scripts import Script

_GUARD_S = 0.4  # after the manager's end, what is left of its scripts is killed
_LOCK_S = 0.02


class Manager(ServiceProcess):
    """``before`` and ``after`` are called around each turn, ``spawned`` at each start of a script."""

    def __init__(self, network: Network, config: Config, commands: Commands) -> None:
        super().__init__("manager", network.scheduler, lambda process: self._service(network, config))
        self.scripts: list[Script] = []  # of all its lives
        self.newest: Script | None = None
        self.before: Callable[[], None] = lambda: None
        self.after: Callable[[], None] = lambda: None
        self.spawned: Callable[[Script], None] = lambda script: None
        self._network, self._commands = network, commands

    @property
    def alive_scripts(self) -> list[Script]:
        return [script for script in self.scripts if script.alive]

    def start(self) -> None:
        """It begins once its predecessor's guard has ended, that is, once the scripts have."""
        if self.alive_scripts and not self.alive:
            self.scheduler.after(_LOCK_S, self.start)
        else:
            super().start()

    def turn(self) -> None:
        self.before()
        super().turn()
        self.after()

    def kill(self, restart_s: float | None) -> None:
        """The kernel and the manager's guard end its scripts."""
        if self.alive:
            for script in self.alive_scripts:
                script.signal(signal.SIGTERM)
                self.scheduler.after(_GUARD_S, lambda script=script: script.signal(signal.SIGKILL))  # type: ignore[misc]
        super().kill(restart_s)

    def _service(self, network: Network, config: Config) -> AutonomyManager:
        return AutonomyManager(
            config,
            Connection(self, network),
            clock=self.scheduler.clock,
            spawn=self._spawn,
            scripts={name: _described(name) for name in NAMES},
        )

    def _spawn(self, launch: Launch, ended: Callable[[int], None]) -> Script:
        life = self.lives

        def on_end(code: int) -> None:
            """The watching thread; it ends with the manager, and does not run while that is frozen."""
            self.do(lambda: notify(code))

        def notify(code: int) -> None:
            if self.alive and self.lives == life:
                ended(code)
                self.wake()

        run = int(launch.environment[RUN])
        script = Script(launch.file, run, self._network, self._commands, on_end)
        self.scripts.append(script)
        self.newest = script
        self.spawned(script)
        return script


NAMES = ("steady", "pulse", "flood", "late", "finish", "fail", "crash", "busy", "idle", "steady-needs", "idle-needed")


def _described(name: str) -> Described:
    return Described(
        file=name,
        label=name,
        command=(name,),
        folder=Path("/"),
        ours=True,
        dependencies=(Dependency("idle-needed"),) if name == "steady-needs" else (),
    )
