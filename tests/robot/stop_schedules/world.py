"""Brokers, a Linux robot with a simulated MCU, a simulated board, the ways between them, and how they fail."""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from pebble.contract import DRIVE, ESTOP, ESTOP_STATE
from pebble.extensions.operator.client.estop import new_name
from pebble.transports import QoS
from tests.robot.rig import Rig, descendants
from tests.robot.stop_schedules.history import History, Wheels
from tests.robot.stop_schedules.people import Driver, Subscriber, base_of, connect
from tests.robot.stop_schedules.schedules import BOARD, ROBOTS, ROVER
from tests.support import ROOT, Broker, Child, until
from tests.tcp_proxy import TcpProxy


class BoardProcess:
    """A simulated robot with Wi-Fi; its files survive it."""

    def __init__(self, folder: Path, kind: str, port: int) -> None:
        self.trace = folder / "board.jsonl"
        self.trace.touch()
        self.wheels = Wheels(self.trace)
        self._command = [
            *(sys.executable, "-m", "pebble.cli", "sim", kind, BOARD, "--broker", f"mqtt://127.0.0.1:{port}"),
            *("--trace", str(self.trace), "--files", str(folder / "files")),
        ]
        self._log = (folder / "board.log").open("ab")
        self.start()

    def start(self) -> None:
        self._process = Child(self._command, cwd=ROOT, stdout=self._log, stderr=self._log)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait(10)
        self.wheels.powered_off(time.monotonic())

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(10)
        self._log.close()


class World:
    """Everything of one set-up, for many schedules; ``history`` is that of the present one."""

    def __init__(self, transport: str, setup: str) -> None:
        self.setup = setup
        self.history = History()
        self.planted: set[str] = set()
        self._saved: bytes | None = None
        self._lock = threading.RLock()  # only one fault at a time restarts something, or cuts the connections
        with ExitStack() as opened:
            self._open(transport, opened)
            self._opened = opened.pop_all()

    def _open(self, transport: str, opened: ExitStack) -> None:
        # Brokers and boards end with the thread that started them: these threads last as long as the world.
        self.threads = opened.enter_context(ThreadPoolExecutor())
        self.folder = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="pbl")))
        persistent = self.setup in ("older save", "failover")
        self.remote = Broker(self.folder, persistence=persistent)
        opened.callback(self.remote.stop)
        self.standby = Broker(self.folder, persistence=True) if self.setup == "failover" else None
        if self.standby is not None:
            opened.callback(self.standby.stop)
        kind, mirror, local = self._wiring(transport)
        self.access = opened.enter_context(TcpProxy(self.remote.port))  # for people
        self.radio = opened.enter_context(TcpProxy(self.remote.port))  # for the board
        self.rig = opened.enter_context(Rig(kind, mirror=mirror, remote=self.remote, local=local))
        self.local_port = (self.rig.local or self.remote).port
        board = "benjr" if len(self.setup) % 2 else "minilamp"
        self.board = opened.enter_context(closing(BoardProcess(self.folder, board, self.radio.port)))
        self.wheels = {ROVER: Wheels(self.rig.folder / "trace.jsonl"), BOARD: self.board.wheels}
        self.subscriber = opened.enter_context(closing(Subscriber(self.access.port, ROBOTS, "remote")))
        self.local_subscriber = opened.enter_context(closing(Subscriber(self.local_port, (ROVER,), "local")))
        self.persons = {robot: self._driver(robot, opened) for robot in ROBOTS}
        if self.setup == "remote-mirror":
            self.rig.operator.send("incoming/flags/remote-mirror", True, retain=True)
        assert self.is_up(time.monotonic(), 20), self.logs()

    def _driver(self, robot: str, opened: ExitStack) -> Driver:
        return opened.enter_context(closing(Driver(self.access.port, robot, self.history)))

    def close(self) -> None:
        self._opened.close()

    def begin(self) -> History:
        """Start a new schedule."""
        self.history = History()
        for subscriber in (self.subscriber, self.local_subscriber):
            subscriber.history = self.history
        for driver in self.persons.values():
            driver.history = self.history
        for wheels in self.wheels.values():
            wheels.forget()
        self.planted = set()
        return self.history

    def is_up(self, since: float, timeout: float) -> bool:
        """Wait until both robots' heartbeats arrive, and states where persons are, except of a robot without stops."""

        def up(robot: str) -> bool:
            known = self.subscriber.robot(robot)
            online = self.subscriber.heartbeats.get(robot, 0.0) > max(since, time.monotonic() - 0.6)
            return online and bool(known.states or (known.has_capabilities and not known.available))

        return until(lambda: all(map(up, ROBOTS)), timeout, step=0.02)

    def logs(self) -> str:
        return f"{self.rig.log.read_text()[-3000:]}\n{(self.folder / 'board.log').read_text()[-1000:]}"

    # -- faults; each returns when it is over

    def fault(self, what: str, seconds: float) -> None:
        """Perform one of those of schedules, and record from when to when."""
        began = time.monotonic()
        action: Callable[..., None] = getattr(self, what.replace(" ", "_"), self._kill_or_freeze)
        arguments = (what, seconds) if action == self._kill_or_freeze else (seconds,)
        action(*arguments)
        self.history.add("fault", at=began, which=what, until=time.monotonic())

    def _kill_or_freeze(self, what: str, seconds: float) -> None:
        how, _, program = what.partition(" ")
        with self._lock:
            pid = self.rig.processes().get(program)
        if pid is None:
            return
        if program == "serial_mcu_bridge":
            self.history.add("owner killed" if how == "kill" else "owner frozen", ROVER, seconds=seconds)
        with suppress(ProcessLookupError):
            if how == "kill":
                os.kill(pid, signal.SIGKILL)
                return
            os.kill(pid, signal.SIGSTOP)
            time.sleep(seconds)
            os.kill(pid, signal.SIGCONT)

    def kill_both(self, seconds: float) -> None:
        for program in ("serial_mcu_bridge", "mqtt_bridge"):
            self._kill_or_freeze(f"kill {program}", seconds)

    def kill_local_transport(self, seconds: float) -> None:
        if self.rig.kind == "zenoh":
            self._kill_or_freeze("kill zenoh_hub", seconds)
        else:
            self._restart(self._local_broker, seconds)

    def freeze_local_transport(self, seconds: float) -> None:
        if self.rig.kind == "zenoh":
            self._kill_or_freeze("freeze zenoh_hub", seconds)
        else:
            self._freeze(self._local_broker, seconds)

    def kill_launcher(self, _: float) -> None:
        with self._lock:
            self.history.add("owner killed", ROVER)
            left = self.rig.kill_launcher()
            until(lambda: not any(self.rig.alive(pid) for pid in left), 5)
            self.rig.start(ready=False)

    def power_cut_rover(self, _: float) -> None:
        """Every process of the robot ends at the same time; what is on disk stays."""
        with self._lock:
            self.history.add("owner killed", ROVER)
            launcher = self.rig.launcher_pid
            os.kill(launcher, signal.SIGSTOP)
            for pid in descendants(launcher):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            self.rig.kill_launcher()
            self.rig.start(ready=False)

    def power_cut_board(self, _: float) -> None:
        with self._lock:
            self.history.add("owner killed", BOARD)
            self.board.kill()
            self.board.start()

    def kill_board(self, seconds: float) -> None:
        self.power_cut_board(seconds)

    def kill_remote_broker(self, seconds: float) -> None:
        self._restart(self.remote, seconds)

    def freeze_remote_broker(self, seconds: float) -> None:
        self._freeze(self.remote, seconds)

    def blackhole(self, seconds: float) -> None:
        for link in (self.rig.uplink, self.radio):
            link.blackhole()
        time.sleep(seconds)
        for link in (self.rig.uplink, self.radio):
            link.resume()

    def cut(self, seconds: float) -> None:
        with self._away():
            time.sleep(seconds)

    def reconnect(self, _: float) -> None:
        with self._lock:
            for link in (self.rig.uplink, self.radio):
                link.drop()

    def failover(self, seconds: float) -> None:
        """The broker is killed, and another one takes its address; what that has retained is older."""
        assert self.standby is not None
        with self._lock:
            self.remote.kill()
            time.sleep(seconds)
            self.remote, self.standby = self.standby, self.remote
            if not self.remote.running:
                self.remote.start()
            self._plant(self.remote.port, states=True)
            for link in (self.access, self.radio, self.rig.uplink):
                link.lead_to(self.remote.port)

    def save_the_broker(self, _: float) -> None:
        with self._lock:
            self.remote.save()
            self._saved = self._database.read_bytes()

    def restore_the_broker(self, _: float) -> None:
        with self._lock:
            assert self._saved is not None
            self.remote.kill()
            self._database.write_bytes(self._saved)
            self.remote.start()

    def plant_a_retained_stop(self, seconds: float) -> None:
        with self._away():
            self._plant(self.remote.port, states=False)
            time.sleep(seconds)

    def _plant(self, port: int, *, states: bool) -> None:
        """Retain a stop that no robot receives while it is live; with ``states`` an old state and a command as well."""
        publisher = connect(port, "plant")
        for robot, owner in ((ROVER, "serial"), (BOARD, "mcu")):
            name, base = new_name(), base_of(robot)
            self.planted.add(name)
            messages: dict[str, Any] = {ESTOP.topic(base): {"stop": name, "by": "old"}}
            if states:
                old = {"latched": False, "boot": "00000000", "count": 0, "recent": [], "by": "", "why": "", "since": 0}
                messages[ESTOP_STATE.topic(base, owner=owner)] = {**old, "reset_refused": None, "persisted": True}
                messages[DRIVE.topic(base)] = {"x": 0, "z": 0.9}
            for topic, body in messages.items():
                publisher.publish(topic, json.dumps(body).encode(), qos=QoS.DELIVERED, retain=True)
        until(lambda: not publisher.outgoing.waiting, 1)
        publisher.close()

    # -- parts

    @property
    def _local_broker(self) -> Broker:
        return self.rig.local or self.remote

    @property
    def _database(self) -> Path:
        return self.folder / f"store-{self.remote.port}" / "mosquitto.db"

    def _restart(self, broker: Broker, seconds: float) -> None:
        with self._lock:
            broker.kill()
            time.sleep(seconds)
            broker.start()

    def _freeze(self, broker: Broker, seconds: float) -> None:
        with self._lock:
            broker.freeze()
            time.sleep(seconds)
            broker.thaw()

    @contextmanager
    def _away(self) -> Iterator[None]:
        """Neither robot is connected to the remote broker."""
        with self._lock:
            for link in (self.rig.uplink, self.radio):
                link.cut()
            yield
            for link in (self.rig.uplink, self.radio):
                link.mend()

    def _wiring(self, transport: str) -> tuple[str, bool, Broker | None]:
        """Rig's kind, whether the robot has a mirror, and its local broker if that is not an ordinary one."""
        if self.setup == "one broker":
            return ("single" if transport == "mqtt" else "zenoh"), False, None
        one = self.setup == "mirror is the remote broker"
        local = self.remote if one else Broker(self.folder)
        return transport, transport == "zenoh", local
