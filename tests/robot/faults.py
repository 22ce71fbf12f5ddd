"""What can happen to a whole robot while an operator drives it, and what must be true of its wheels then."""

from __future__ import annotations

import itertools
import mmap
import os
import secrets
import shutil
import signal
import socket
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from pebble.config import LAUNCHER_LOCK
from tests.kit.mqtt_bytes import connect, publish
from tests.kit.stalls import lost_s, stalls
from tests.robot.operator import Driver, Operator, number_of
from tests.robot.rig import BASE, STOP, Rig, restore, saved_by
from tests.small_disk import SmallDisk
from tests.support import SOON_S, Broker, gone, until
from tests.transports.net import Forked

AGE_S = 2.5  # no older command ever reaches the wheels
_TURNS_S = 1.0  # 0.75 after a line, and what a busy machine may add
_MCU_TURNS_S = 1.6  # where no process is left to send a zero, the MCU stops by itself after a second
_FIRST_LINE_S = 0.3
_OWNER = "serial_mcu_bridge"

_numbers = itertools.count(1, 2000)


class Drive:
    """One drive through a fault: ``turns_s`` is how long wheels may turn without another line."""

    def __init__(self, rig: Rig, operator: Operator | None = None, *, turns_s: float = _TURNS_S) -> None:
        stalls()  # watches from now on
        self.rig, self._turns_s = rig, turns_s
        self.began = time.monotonic()
        self.back_s = self.age_s = 0.0
        self.driver = Driver(operator or rig.operator, first=next(_numbers))
        try:
            assert until(lambda: rig.mcu.moving(self.began)), "the robot did not even start to move"
        except BaseException:
            self.driver.stop()
            raise

    def end(self, over: float) -> None:
        """Wait until commands sent after the fault get through; then let go."""
        assert until(lambda: any(self.driver.sent_at[number] >= over for _, number in self._commands(over))), (
            "no driving after the fault's end"
        )
        self.back_s = time.monotonic() - over
        assert self.back_s < 2 * SOON_S, f"driven again {self.back_s:.1f} s after the fault's end"
        self.finish()

    def finish(self) -> None:
        """Let go, and check how the wheels have turned."""
        self.driver.stop()
        assert until(lambda: not self.rig.mcu.moving(self.began))
        assert until(lambda: not self.rig.mcu.turning())
        for at, number in self._commands(self.began):
            self.age_s = max(self.age_s, at - self.driver.sent_at[number])
        assert self.age_s <= AGE_S, f"a command moved the wheels {self.age_s:.2f} s after it was sent"
        turned_s = self._longest_turn()
        assert turned_s <= self._turns_s, f"the wheels turned for {turned_s:.3f} s without another line"
        drives = self.rig.mcu.drives(self.began)
        for entry in self.rig.mcu.entries(self.began):
            if entry.event == "opened":
                opened = entry.ns / 1e9
                first = next((at - opened, wheels) for at, wheels in drives if at >= opened)
                assert first[1] == STOP, "the first line on an open port is no stop"
                assert first[0] <= _FIRST_LINE_S

    def _longest_turn(self) -> float:
        """Return the seconds that motors turned after a line until the next one, or until they stood still.

        Times in which the machine did not run its processes are left out.
        """
        mcu = self.rig.mcu
        events = [(at, None) for at, _ in mcu.drives(self.began)]
        stalled = [*stalls().found, *mcu.late(self.began)]
        longest, turning, line = 0.0, False, self.began
        for at, turns in sorted([*events, *((at, wheels != STOP) for at, wheels in mcu.motors(self.began))], key=_at):
            if turning:
                longest = max(longest, at - line - lost_s(stalled, line, at))
            if turns is None:
                line = at
            else:
                turning = turns
        return longest

    def _commands(self, since: float) -> list[tuple[float, int]]:
        return [(at, number_of(*wheels)) for at, wheels in self.rig.mcu.drives(since) if wheels != STOP]


def _at(event: tuple[float, bool | None]) -> float:
    return event[0]


# -- each of them begins, and ends after a while


@contextmanager
def _killed(program: str, rig: Rig) -> Iterator[None]:
    rig.kill(program)
    yield


def _announcer(rig: Rig) -> str:
    """Return the process that publishes for the launcher: on Zenoh that of the hub."""
    return "zenoh_hub" if rig.local is None else "announcer"


@contextmanager
def _launcher_killed(rig: Rig) -> Iterator[None]:
    """Kill the launcher, and start it again, as systemd does."""
    killed, children = time.monotonic(), rig.kill_launcher()
    yield
    assert until(lambda: all(map(gone, children))), "children outlived their launcher"
    stopped_at, wheels = rig.mcu.drives(killed)[-1]
    assert wheels == STOP
    assert stopped_at - killed <= 1.0
    rig.start(ready=False)


@contextmanager
def _run_directory_removed(rig: Rig) -> Iterator[None]:
    """Remove it: all programs start again, and the lock is held again."""
    run = rig.folder / "run"
    sockets = len(list(run.glob("*.seat")))
    shutil.rmtree(run)
    yield
    assert until(lambda: (run / LAUNCHER_LOCK).exists() and len(list(run.glob("*.seat"))) >= sockets)


@contextmanager
def _local_transport_killed(rig: Rig) -> Iterator[None]:
    """Kill the local broker, or on Zenoh the hub, whose death must not interrupt driving."""
    if rig.local is not None:
        rig.local.kill()
        time.sleep(1)
        rig.local.start()  # without its retained messages
    else:
        rig.kill("zenoh_hub")
    yield


@contextmanager
def _remote_broker_restarted(rig: Rig) -> Iterator[None]:
    rig.remote.kill()
    yield
    rig.remote.start()


@contextmanager
def silent(rig: Rig) -> Iterator[None]:
    rig.uplink.blackhole()
    yield
    rig.uplink.resume()


@contextmanager
def _lost(rig: Rig) -> Iterator[None]:
    for _ in range(5):
        rig.uplink.drop()
        time.sleep(0.2)
    yield


@contextmanager
def _unplugged(rig: Rig) -> Iterator[None]:
    rig.mcu.command("unplug")
    yield
    rig.mcu.command("replug")


@contextmanager
def frozen(*pids: int) -> Iterator[None]:
    """Let processes stand still, as on a machine that swaps."""
    for number in (signal.SIGSTOP, signal.SIGCONT):
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, number)
        if number == signal.SIGSTOP:
            yield


@dataclass(frozen=True)
class Fault:
    """A fault that lasts for some seconds. ``turns_s``: how long wheels may turn without another line."""

    happens: Callable[[Any], AbstractContextManager[object]]  # of a rig
    seconds: float = 0.2
    turns_s: float = _TURNS_S

    def perform(self, rig: Rig, drive: Drive, meanwhile: Callable[[], object] = lambda: None) -> None:
        try:
            with self.happens(rig):
                time.sleep(self.seconds / 2)
                meanwhile()
                time.sleep(self.seconds / 2)
            drive.end(time.monotonic())
        finally:
            drive.driver.stop()


FAULTS = {
    "the serial bridge is killed": Fault(partial(_killed, _OWNER), turns_s=_MCU_TURNS_S),
    "the mqtt bridge is killed": Fault(partial(_killed, "mqtt_bridge")),
    "the announcer is killed": Fault(lambda rig: _killed(_announcer(rig), rig)),
    "the announcer stands still": Fault(lambda rig: frozen(rig.processes()[_announcer(rig)]), 2.8),
    "the launcher is killed": Fault(_launcher_killed, turns_s=_MCU_TURNS_S),
    "the run directory is removed": Fault(_run_directory_removed, turns_s=_MCU_TURNS_S),
    "the local transport is killed": Fault(_local_transport_killed),
    "the remote broker is restarted": Fault(_remote_broker_restarted),
    "the link is silent": Fault(silent, 3.0),
    "the link is silent for long": Fault(silent, 10.0),
    "the link is lost again and again": Fault(_lost),
    "the board is unplugged": Fault(_unplugged, 3.0, turns_s=_MCU_TURNS_S),
    "the serial bridge stands still": Fault(
        lambda rig: frozen(rig.processes()[_OWNER]), 2.8, turns_s=_MCU_TURNS_S
    ),
    "the whole robot stands still": Fault(
        lambda rig: frozen(*rig.processes().values(), rig.launcher_pid), 2.8, turns_s=_MCU_TURNS_S
    ),
}  # fmt: skip


_SLICE_S = 0.02
_CONNACK_BYTES = 4


@dataclass(frozen=True)
class Flood:
    """Messages of a stranger to the robot: ``{n}`` in the topic counts to ``topics`` and begins anew."""

    topic: str
    payload: bytes
    per_second: int
    topics: int = 1
    retain: bool = False

    def packets(self, first: int, last: int) -> bytes:
        topics = (self.topic.format(n=number % self.topics) for number in range(first, last))
        return b"".join(publish(f"{BASE}/{topic}", self.payload, retain=self.retain) for topic in topics)

    def removals(self, sent: int) -> Iterator[bytes]:
        for number in range(min(sent, self.topics) if self.retain else 0):
            yield publish(f"{BASE}/{self.topic.format(n=number)}", b"", retain=True)


FLOODS = {
    "retained flags": Flood("incoming/flags/f{n}", b"x" * 100, 6_000, 60_000, retain=True),
    "retained topics": Flood("incoming/mcu/k/n{n}", b"x" * 20, 10_000, 100_000, retain=True),
    "actions": Flood("incoming/flags/reboot", b"true", 10_000),
    "unknown commands": Flood("incoming/unknown/n{n}", b"{}", 5_000, 100_000),
    "60 MB once a second": Flood("incoming/drive-values", bytes(60 << 20), 1),
    "a flag of 2 MB": Flood("incoming/flags/large", bytes(2 << 20), 1, retain=True),
}


@contextmanager
def flooding(name: str, port: int, seconds: float) -> Iterator[Forked]:
    """Floods from a process of its own, which removes afterwards what was retained; waits for its end."""
    process = Forked("tests.robot.faults", name, port, seconds)
    yield process
    process.wait(seconds + 60)


def send(broker: socket.socket, flood: Flood, seconds: float) -> int:
    """At its pace, as far as the broker reads so fast; returns how many messages that was."""
    began, sent = time.monotonic(), 0
    while (passed := time.monotonic() - began) < seconds:
        due = min(int(passed * flood.per_second) + 1, sent + max(1, flood.per_second // 10))
        broker.sendall(flood.packets(sent, due))
        sent = due
        time.sleep(_SLICE_S)
    return sent


def main(name: str, port: int, seconds: float) -> None:
    flood = FLOODS[name]
    with suppress(ConnectionError), socket.create_connection(("127.0.0.1", port)) as broker:
        broker.sendall(connect(None, None, client_id=f"flood-{secrets.token_hex(4)}"))
        broker.recv(_CONNACK_BYTES)
        for packet in flood.removals(send(broker, flood, seconds)):
            broker.sendall(packet)


#: Python imports it at the start of each process of the robot. Zenoh's own clock does not jump.
_CLOCK = """\
import mmap, os, struct, time

with open(os.environ["TEST_CLOCK"], "r+b") as file:
    ahead = mmap.mmap(file.fileno(), 8)
clock, clock_ns = time.time, time.time_ns
time.time_ns = lambda: clock_ns() + struct.unpack("q", ahead)[0]
time.time = lambda: clock() + struct.unpack("q", ahead)[0] / 1e9
"""


class HarshRig(Rig):
    """A robot with small disks of its own and a clock that can jump, at a broker that saves. Needs root."""

    def __init__(self, kind: str) -> None:
        self._broker_folder = tempfile.TemporaryDirectory(prefix="pbl")
        place = Path(self._broker_folder.name)
        (place / "clock").write_bytes(bytes(8))
        (place / "sitecustomize.py").write_text(_CLOCK)
        with (place / "clock").open("r+b") as clock:
            self._ahead = mmap.mmap(clock.fileno(), 8)
        self._environment = {"TEST_CLOCK": str(place / "clock"), "PYTHONPATH": str(place)}
        broker = Broker(place, persistence=True, autosave=False)
        super().__init__(kind, mcu="fred", start=False, remote=broker, listens="outgoing/#")
        self._disks = [SmallDisk(self.folder / name, mebibytes=8) for name in ("run", "state")]
        for disk in self._disks:
            disk.mount("mode=700")

    def start(self, ready: bool = True, **options: Any) -> float:
        return super().start(ready, env=os.environ | self._environment, **options)

    def close(self) -> None:
        self.ensure_stopped()
        for disk in self._disks:
            disk.close()
        super().close()
        self._broker_folder.cleanup()

    @contextmanager
    def jump(self, seconds: int) -> Iterator[None]:
        self._ahead[:] = struct.pack("q", seconds * 10**9)
        yield
        self._ahead[:] = bytes(8)

    @contextmanager
    def full(self) -> Iterator[None]:
        with ExitStack() as ends:
            for disk in self._disks:
                ends.enter_context(disk.full())
            yield

    @contextmanager
    def restored(self) -> Iterator[None]:
        """Give the broker an older save."""
        saved = saved_by(self.remote)
        time.sleep(1)  # in which heartbeats and states change
        self.remote.kill()
        restore(saved)
        yield
        self.remote.start()


#: Of a harsh rig.
HARSH = {
    "a clock a day ahead": Fault(lambda rig: rig.jump(86_400), 3.0),
    "a clock an hour behind": Fault(lambda rig: rig.jump(-3_600), 3.0),
    "full disks": Fault(HarshRig.full, 3.0),
    "a broker of before": Fault(HarshRig.restored),
    **{name: Fault(lambda rig, name=name: flooding(name, rig.remote.port, 3.0), 3.0) for name in FLOODS},  # type: ignore[misc]
}
