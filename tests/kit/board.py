"""A scripted self-describing MCU on a real pty, its bridge, and a robot's local transport."""

from __future__ import annotations

import os
import select
import struct
import threading
import time
import tty
from collections.abc import Callable
from contextlib import ExitStack, suppress
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pebble.config import Config
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from pebble.extension import part
from pebble.runtime.process import view_of
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import Frame, decode
from tests.ext.boards import mcu_wire as wire
from tests.ext.boards.mcu_wire import M
from tests.kit.robot import ROBOT, Listener, LocalNetwork, Running
from tests.support import WAIT_S, until

_numbers = count()
STEP_S = 0.002
BOOT_S = 0.05  # before the HELLO: a host discards the input from before it opened the port


class ScriptedMcu:
    """An MCU that answers DESCRIBE_REQ and PING, acknowledges commands, and sends a test's frames.

    ``stream`` sends a payload of its first interface periodically, numbered from 1 each time it is plugged in.
    """

    def __init__(self, link: Path, manifest: M, *, sends_hello: bool = False) -> None:
        self.link, self.manifest, self.sends_hello = link, manifest, sends_hello
        self.answers: Callable[[Frame], bytes] = lambda received: wire.frame(
            wire.ACK, b"", received.interface, received.sequence
        )
        self.after_describing = b""
        self.half = b""  # the partial frame of an earlier host in its buffer when it is plugged in
        self.silent = False
        self.received: list[tuple[float, Frame]] = []
        self.plugged_at = 0.0
        self.samples_sent = 0  # numbered samples since it was plugged in
        self._stream: tuple[float, bytes, int] | None = None
        self._next = 0.0
        self._master = -1
        self._host = self._hello_sent = False
        self._boots_until = 0.0
        self.rest = b""
        self._lock = threading.Lock()
        self._ending = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def plug(self) -> None:
        with self._lock:
            self._master, slave = os.openpty()
            tty.setraw(slave)
            os.set_blocking(self._master, False)
            new = self.link.with_suffix(".new")
            new.symlink_to(os.ttyname(slave))
            os.close(slave)
            self.rest, self._host, self._hello_sent, self.samples_sent = self.half, False, False, 0
            self.plugged_at = time.monotonic()
            new.replace(self.link)

    def unplug(self) -> None:
        with self._lock:
            self.link.unlink(missing_ok=True)
            os.close(self._master)
            self._master = -1

    def send(self, *frames: bytes) -> None:
        with self._lock:
            self._write(b"".join(frames))

    def pour(self, data: bytes) -> None:
        """Write ``data`` as fast as the host reads it."""
        poller = select.poll()
        poller.register(self._master, select.POLLOUT)
        while data:
            assert poller.poll(5000), "the host does not read"
            with self._lock, suppress(BlockingIOError):
                data = data[os.write(self._master, data) :]

    def stream(self, hertz: float, payload: bytes, kind: int = wire.SAMPLE) -> None:
        with self._lock:
            self._stream, self._next = (1 / hertz, payload, kind), time.monotonic()

    def commands(self) -> list[Frame]:
        return [received for _, received in list(self.received) if received.type == wire.CMD]

    def obeyed(self, count: int = 1) -> list[tuple[int, bytes]]:
        """Wait for ``count`` commands; return the interface and the payload of each."""
        assert until(lambda: len(self.commands()) >= count)
        return [(command.interface, command.payload) for command in self.commands()]

    def asked(self) -> int:
        return sum(received.type == wire.DESCRIBE_REQ for _, received in list(self.received))

    def close(self) -> None:
        self._ending = True
        self._thread.join(WAIT_S)
        if self._master >= 0:
            self.unplug()

    def __enter__(self) -> Self:
        self.plug()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    # -- on its own thread

    def _run(self) -> None:
        while not self._ending:
            time.sleep(STEP_S)
            with self._lock, suppress(OSError):
                if self._master >= 0:
                    self._turn()

    def _turn(self) -> None:
        poller = select.poll()
        poller.register(self._master, select.POLLIN)
        events = poller.poll(0)
        if not events or not events[0][1] & select.POLLHUP:
            if not self._host:
                self._host, self._boots_until = True, time.monotonic() + BOOT_S
            if self.sends_hello and not self._hello_sent and time.monotonic() >= self._boots_until:
                self._hello_sent = True
                self._write(wire.frame(wire.HELLO, self.manifest.hello()))
        if events and events[0][1] & select.POLLIN:
            *frames, self.rest = (self.rest + os.read(self._master, 65536)).split(b"\0")
            for stuffed in frames:
                if stuffed not in (b"", self.half):
                    self._receive(decode(stuffed))
        if self._host and self._stream is not None and not self.silent:
            period_s, payload, kind = self._stream
            while time.monotonic() >= self._next:
                self._next += period_s
                self.samples_sent += 1
                self._write(wire.frame(kind, payload, 1, self.samples_sent, self.samples_sent * 10))

    def _receive(self, received: Frame) -> None:
        self.received.append((time.monotonic(), received))
        if self.silent:
            return
        if received.type == wire.DESCRIBE_REQ:
            self._write(wire.frame(wire.DESCRIBE, self.manifest.describe()) + self.after_describing)
        elif received.type == wire.PING:
            self._write(wire.frame(wire.PONG))
        elif received.type == wire.CMD:
            self._write(self.answers(received))

    def _write(self, data: bytes) -> None:
        if self._master >= 0 and data:
            os.write(self._master, data)


class SerialRig:
    """A local transport, a subscriber, and any number of serial lines with an MCU each, by instance name.

    On a ``network`` that several rigs share, its robot has a unique name.
    """

    def __init__(self, kind: str, folder: Path, network: LocalNetwork | None = None) -> None:
        self.folder, self._ends = folder, ExitStack()
        self._robot = ROBOT if network is None else f"{ROBOT}-{next(_numbers)}"
        self.base = f"pebble/robots/{self._robot}"
        if network is None:
            network = LocalNetwork(kind, folder)
            self._ends.callback(network.close)
        self.network = network
        self.world = world = self.listener("world")
        self.described, self.got, self.cleared, self.values = world.described, world.got, world.cleared, world.values
        self._config: Config | None = None
        self.lines: dict[str, Running] = {}
        self.mcus: dict[str, ScriptedMcu] = {}

    def listener(self, name: str) -> Listener:
        listener = Listener(self.network.client(name), self.base)
        self._ends.callback(listener.transport.close)
        return listener

    def mcu(self, manifest: M, name: str = "one", *, plugged: bool = True, sends_hello: bool = True) -> ScriptedMcu:
        """Plug in an MCU, and return it. Without a hello, a bridge asks for its manifest only after a while."""
        mcu = self.mcus[name] = ScriptedMcu(self.folder / name, manifest, sends_hello=sends_hello)
        self._ends.callback(mcu.close)
        if plugged:
            mcu.plug()
        return mcu

    def bridge(
        self, name: str = "one", protocol: str = "pebble_serial_v1", *, groups: bool = False, **section: Any
    ) -> Running:
        """Start the service for the MCU of that name; ``section`` is the rest of its config."""
        line = {"enabled": True, "protocol": protocol, "serial": {"port": str(self.folder / name)}, **section}
        services = {"mqtt_bridge": {"link": {"groups": True}}} if groups else {}
        lines = {"instances": {name: line}}
        config = view_of(self.network.config(self.folder, lines, robot=self._robot, **services), name)
        transport = self.network.robots_transport(config, f"serial-{name}")
        service = part(SERIAL_PROTOCOLS[protocol].service)
        running = self.lines[name] = Running(service(config, transport, instance=name))
        self._ends.callback(running.stop)
        return running

    def up(self, manifest: M, name: str = "one", **section: Any) -> tuple[ScriptedMcu, Running]:
        """Plug an MCU in and start its bridge; return when its manifest is published and its aliases are in use."""
        mcu, running = self.mcu(manifest, name), self.bridge(name, **section)
        self.described(manifest.uid)
        assert self.claimed(name)
        return mcu, running

    def claimed(self, name: str = "one") -> bool:
        """Wait until other devices could have objected to the aliases, and those of commands are subscribed to."""
        service, done = self.lines[name].service, threading.Event()
        if not until(lambda: service.aliases.permitted, 5):  # type: ignore[attr-defined]
            return False
        service.post(done.set)  # the subscriptions are made by the job that permits
        return done.wait(WAIT_S)

    def close(self) -> None:
        self._ends.close()


def motion(ax: int = 9807) -> bytes:
    """Return a payload of the inertial sensor's first interface."""
    return struct.pack("<9h", ax, -20, 3, 100, -100, 1, 2512, 33, -7)


def summary() -> bytes:
    return struct.pack("<H3hIIH", 1001, 5, -6, 7, 1000, 2, 200)
