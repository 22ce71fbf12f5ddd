"""The motor owner: the real service, with a recorded serial line, files in memory, and a deadline behind it.

And the bridge: the real service, and operators' messages that wait for it at their broker.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import msgspec

from pebble.config import Config
from pebble.extensions.fleet import robot_audit
from pebble.extensions.fleet.robot_audit import Audit
from pebble.motors import control, motor_guard, motor_owner
from pebble.services.mqtt_bridge import service as bridge_module
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.services.serial_mcu_bridge.line.outbox import Outbox
from pebble.services.serial_mcu_bridge.line.serial_line import LineState
from pebble.services.serial_mcu_bridge.text import goob_base
from pebble.services.serial_mcu_bridge.text.motor_bridge import MotorBridge
from pebble.transports import Answer, Message, clock
from pebble.transports.mqtt.read_age import BrokerDelay
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
        self.deadline = 0.0  # of the newest drive command that the line was given

    def receive(self, line: bytes) -> None:
        self._line, self._at = line, self._scheduler.now

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

    def drive(self, line: bytes, valid_s: float) -> None:
        self._wheels.deadline = self._scheduler.now + valid_s
        self._outbox.drive(line, self._scheduler.now, valid_s)
        self._pump()

    def halt(self) -> None:
        self._outbox.halt()
        self._pump()

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


_TRAVEL_S = 0.001
_PING_S = 0.45


class Outside(Network):
    """The operators' broker: all that it has for the bridge waits in one queue, but for the connection of stops.

    ``comes(message)``: the bridge has a message.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        sent: Callable[[Process, Message], None],
        comes: Callable[[Message], None],
    ) -> None:
        super().__init__(scheduler, lambda _process, _message: None, sent)
        self.comes = comes
        self._floods: list[tuple[float, float]] = []  # until when what comes has to wait so long
        self._stalled_until = self._free_at = 0.0

    def flood(self, seconds: float, lag_s: float) -> None:
        self._floods.append((self.scheduler.now + seconds, lag_s))

    def stall(self, seconds: float) -> None:
        """Send nothing for so long."""
        self._stalled_until = self.scheduler.now + seconds

    def calm(self) -> None:
        """End floods and stalls."""
        self._floods, self._stalled_until = [], 0.0

    def arrival(self) -> float:
        """When the bridge has what comes now."""
        now = self.scheduler.now
        lag_s = max((lag_s for until, lag_s in self._floods if now < until), default=0.0)
        self._free_at = max(self._free_at, now + lag_s + _TRAVEL_S, self._stalled_until)
        return self._free_at

    def _send(self, delivery: Any, client: Connection, number: int, sender: Process | None) -> None:
        if not isinstance(client, Remote) or client.of_stops or sender is None:
            super()._send(delivery, client, number, sender)
            return
        at = max(self.scheduler.now + _TRAVEL_S + sender.delay, self._last.get((sender, client), 0.0))
        self._last[sender, client] = at
        self.scheduler.at(at, lambda: self._queue(delivery, client, number))

    def _queue(self, delivery: Any, client: Remote, number: int) -> None:
        came = self.scheduler.now

        def arrive() -> None:
            since = clock.since_boot() - (self.scheduler.now - came)  # the machine's clock stands still meanwhile
            message = msgspec.structs.replace(delivery.message, waiting_since=since)
            client.arrive(replace(delivery, message=message), number)

        self.scheduler.at(self.arrival(), lambda: client.process.do(arrive))


class Remote(Connection):
    """A connection of the bridge to the operators' broker, which answers pings behind what waits there.

    ``of_stops``: the one of stops alone. While it is ``deaf`` it is lost, and that has not been noticed.
    """

    def __init__(self, process: Process, network: Outside, *, of_stops: bool = False) -> None:
        super().__init__(process, network)
        self._outside, self._delay, self._answers = network, BrokerDelay(), 0
        self.of_stops, self.deaf = of_stops, False

    def arrive(self, delivery: Any, number: int) -> None:
        if self.deaf or number != self.number or not self._present:
            return
        self._outside.comes(delivery.message)
        super().arrive(delivery, number)

    @property
    def answer(self) -> Answer | None:
        delivered_s, late_s = self._delay.delivery(self.network.scheduler.now)
        return Answer(self._answers, 0.0, None, delivered_s, late_s) if self._answers else None

    def _connect(self) -> None:
        super()._connect()
        self._delay, self._answers = BrokerDelay(), 0
        self._delay.usual(2 * _TRAVEL_S)
        self._ping(self.number)

    def _ping(self, number: int) -> None:
        if number != self.number or not self._present:
            return
        if not self.process.frozen:
            self._delay.asked(self.network.scheduler.now, clear=True)
            at = self._outside.arrival() + self.process.delay
            self.network.scheduler.at(at, lambda: self.process.do(lambda: self._pong(number)))
        self.network.scheduler.after(_PING_S, lambda: self._ping(number))

    def _pong(self, number: int) -> None:
        if number == self.number:
            self._answers += 1
            self._delay.answered(self.network.scheduler.now)
            self._delay.delivered()


class Unwritten(Audit):
    """An audit without a thread, which would write and publish in real time."""

    def start(self) -> None:
        """Nothing is written."""

    def close(self) -> None:
        """Nothing waits."""


class Bridge(ServiceProcess):
    """The bridge between ``inside`` and ``outside``."""

    def __init__(self, inside: Network, outside: Outside, config: Config) -> None:
        super().__init__("bridge", inside.scheduler, lambda process: self._service(inside, outside, config))
        self.remote: Remote | None = None
        self.stops: Remote | None = None
        self._local: Connection | None = None

    def _service(self, inside: Network, outside: Outside, config: Config) -> MqttBridge:
        self._local = Connection(self, inside)
        remote, stops = Remote(self, outside), Remote(self, outside, of_stops=True)
        self.remote, self.stops = remote, stops
        with (
            patch.object(bridge_module, "remote_transport", lambda *_arguments, **_options: remote),
            patch.object(bridge_module, "stops_transport", lambda _config: stops),
            patch.object(robot_audit, "Audit", Unwritten),
        ):
            return MqttBridge(config, self._local, clock=self.scheduler.clock)

    @property
    def reaches_owners(self) -> bool:
        """True if it runs and has its connection to the robot."""
        return self.alive and not self.frozen and self._local is not None and self._local._present

    @property
    def _connections(self) -> list[Connection]:
        return [one for one in (self._local, self.remote, self.stops) if one is not None]

    def thaw(self) -> None:
        frozen_s = self.scheduler.now - self.frozen_at
        for connection in self._connections if self.frozen else ():
            connection.silent(frozen_s)
        super().thaw()

    def lose(self, seconds: float, *, local: bool) -> None:
        """Lose one of the two connections for so long."""
        connection = self._local if local else self.remote
        assert connection is not None
        connection.lose(seconds)

    def lose_stops(self, noticed_s: float, seconds: float) -> None:
        """Lose the connection of stops; that is noticed after a while, and it is made again."""
        stops = self.stops
        assert stops is not None
        stops.deaf = True

        def notice() -> None:
            stops.deaf = False
            stops.lose(seconds)

        self.scheduler.after(noticed_s, notice)

    def find(self) -> None:
        """Find what was lost."""
        for connection in self._connections:
            connection.find()

    def leave(self) -> None:
        super().leave()
        for connection in self._connections:
            connection.network.crash(connection)
