"""The motor owner: the real service, with a recorded serial line, files in memory, and a deadline behind it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import msgspec

from pebble.config import Config
from pebble.motors import control, motor_guard, motor_owner
from pebble.services.serial_mcu_bridge.line.outbox import Outbox
from pebble.services.serial_mcu_bridge.line.serial_line import LineState
from pebble.services.serial_mcu_bridge.text import goob_base
from pebble.services.serial_mcu_bridge.text.motor_bridge import MotorBridge
from tests.robot.lockstep.network import Connection, Network, Process, Scheduler, ServiceProcess

DEADMAN_S = 1.0  # of the MCU
_BOOT_S = 0.5
_SAVED_S = 0.003
_STOP = goob_base.STOP

Disk = dict[Path, bytes]


class Wheels:
    """What the MCU does with the lines that it receives."""

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self._line = _STOP
        self._at = scheduler.now
        self.lights = b""  # that came with the newest drive line
        self.alone = 0  # lines of lights without one
        self.deadline = 0.0  # of the newest drive command that the line was given

    def receive(self, line: bytes) -> None:
        drive, end, self.lights = line.partition(b"\n")
        self._line, self._at = drive + end, self._scheduler.now

    @property
    def speeds(self) -> tuple[int, int] | None:
        """The speeds in thousandths; None: they do not turn."""
        if self._line == _STOP or self._scheduler.now - self._at >= DEADMAN_S:
            return None
        _, left, right = self._line.split()
        return round(1000 * float(left)), round(1000 * float(right))


class RecordedLine:
    """Stands in for SerialLine; the outbox is the real one."""

    opened = 1
    problem = ""
    state = LineState.CLOSED  # so that it is not reported: that goes by the real clock

    def __init__(self, wheels: Wheels, process: Process, scheduler: Scheduler) -> None:
        self._wheels, self._process, self._scheduler = wheels, process, scheduler
        self._outbox = Outbox(_STOP, 0.75)
        self._open = self._ready = False

    def open(self) -> None:
        self._open = True
        self._wheels.receive(_STOP)
        self._scheduler.after(_BOOT_S, lambda: self._process.do(self._become_ready))

    def close(self) -> None:
        self._wheels.receive(_STOP)

    def drive(self, line: bytes, valid_s: float, *, replaces: str = "") -> None:
        self._wheels.deadline = self._scheduler.now + valid_s
        self._outbox.drive(line, self._scheduler.now, valid_s, replaces)
        self._pump()

    def halt(self) -> None:
        self._outbox.halt()
        self._pump()

    def send(self, kind: str, line: bytes) -> None:
        """Lights turn no wheel."""
        self._wheels.alone += 1

    def _become_ready(self) -> None:
        """Unless the process has ended meanwhile."""
        if self._process.alive and getattr(self._process.service, "line", None) is self:  # type: ignore[attr-defined]
            self._ready = True
            self._wheels.receive(_STOP)
            self._pump()

    def _pump(self) -> None:
        while self._ready and (line := self._outbox.take(self._scheduler.now)) is not None:
            self._wheels.receive(line)


class MemoryFile:
    """Stands in for StateFile: what is saved is on the disk ``writes_s`` later, and known to be there after that."""

    def __init__(
        self,
        disk: Disk,
        process: Process,
        writes_s: float,
        path: Path,
        on_saved: Callable[[int, bool], None] = lambda _n, _ok: None,
    ) -> None:
        self.path = path
        self.busy, self.in_place, self.lost = False, True, False
        self._disk, self._process, self._writes_s, self._on_saved = disk, process, writes_s, on_saved
        self._number = 0

    def can_save(self) -> bool:
        return True

    def load(self) -> Any:
        return msgspec.json.decode(self._disk[self.path]) if self.path in self._disk else None

    def appeared(self) -> Any:
        """Nothing: what is on the disk was there at the start, or is from this process."""

    def save(self, value: Any) -> int:
        self._number += 1
        number, life, written = self._number, self._process.connection, msgspec.json.encode(value)

        def write() -> None:
            if self._process.connection is life:
                self._disk[self.path] = written
                self._process.scheduler.after(_SAVED_S, lambda: self._process.do(saved))

        def saved() -> None:
            if self._process.connection is life:
                self.busy = number < self._number
                self._on_saved(number, True)
                self._process.wake()

        if self._writes_s:
            self.busy = True
            self._process.scheduler.after(self._writes_s, lambda: self._process.do(write))
        else:
            write()
        return number

    def close(self) -> None:
        """It is written already."""


class Owner(ServiceProcess):
    """``after`` is called after each turn."""

    def __init__(
        self,
        network: Network,
        config: Config,
        disk: Disk,
        wheels: Wheels,
        *,
        instance: str,
        token_hex: Callable[[int], str],
        writes_s: float,
    ) -> None:
        """``token_hex``: of each boot and key. ``writes_s``: to disk."""
        super().__init__("owner" + instance, network.scheduler, lambda process: self._service(network, config, disk))
        self.wheels = wheels
        self._instance, self._writes_s = instance, writes_s
        self._token_hex = token_hex
        self.after: Callable[[], None] = lambda: None

    def _service(self, network: Network, config: Config, disk: Disk) -> MotorBridge:
        def file(path: Path, *on_saved: Any) -> MemoryFile:
            return MemoryFile(disk, self, self._writes_s, path, *on_saved)

        random = SimpleNamespace(token_hex=self._token_hex)
        with (
            patch.object(motor_owner, "StateFile", file),
            patch.object(motor_guard, "secrets", random),
            patch.object(control, "secrets", random),
        ):
            service = MotorBridge(
                config, Connection(self, network), instance=self._instance, clock=self.scheduler.clock
            )
        service.line.close()
        service.line = RecordedLine(self.wheels, self, self.scheduler)  # type: ignore[assignment]
        return service

    def turn(self) -> None:
        super().turn()
        self.after()
