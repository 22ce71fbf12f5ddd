"""A whole robot, at a broker that saves, with small disks of its own and a clock that can jump."""

from __future__ import annotations

import mmap
import os
import shutil
import signal
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.robot.operator import Operator
from tests.robot.rig import BASE, Rig, descendants
from tests.support import Broker, process_name

_DISK = "8m"
#: Python imports it at the start of each process of the robot. Zenoh's own clock does not jump.
_CLOCK = """\
import mmap, os, struct, time

with open(os.environ["SOAK_CLOCK"], "r+b") as file:
    ahead = mmap.mmap(file.fileno(), 8)
clock, clock_ns = time.time, time.time_ns
time.time_ns = lambda: clock_ns() + struct.unpack("q", ahead)[0]
time.time = lambda: clock() + struct.unpack("q", ahead)[0] / 1e9
"""


class World:
    """The rig, the operator who drives, and what can happen to the machine around them."""

    def __init__(self, transport: str, *, direct: bool = False) -> None:
        """``direct``: the robot's link to the remote broker cannot fail."""
        self._mounted: list[Path] = []
        self._folder = Path(f"/tmp/pebble-soak-{os.getpid()}")
        self._folder.mkdir(mode=0o700)
        self.remote = Broker(self._folder, persistence=True, autosave=False)
        self.older: dict[str, bytes] = {}  # what the remote broker saved some time ago
        never = {"command": ["true"]}
        actions = {f"{name}_control": never for name in ("reboot", "service_restart", "git_pull")}
        self.rig = Rig(
            transport,
            mcu="fred",
            start=False,
            direct=direct,
            remote=self.remote,
            listens="outgoing/#",
            mqtt_bridge=actions,
        )
        self.operator = Operator(self.remote.port, BASE, "outgoing/online")
        self.disks = [self.rig.folder / name for name in ("run", "state")]
        for disk in self.disks:
            disk.mkdir(mode=0o700)
            self._mount(disk)
        self._ahead = self._make_clock()

    def start(self, *, ready: bool = True) -> None:
        self.rig.start(ready)

    def close(self) -> None:
        self.operator.close()
        self.rig.ensure_stopped()
        for disk in self._mounted:
            subprocess.run(["umount", "--lazy", str(disk)], check=False)
        self.rig.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    # -- processes

    @property
    def robot(self) -> dict[str, int]:
        """All processes, the launcher among them, by name."""
        names = self.rig.processes() | {"launcher": self.rig.launcher_pid}
        others = [pid for pid in descendants(self.rig.launcher_pid) if pid not in names.values()]
        return names | {process_name(pid): pid for pid in others}

    @contextmanager
    def still(self, *pids: int) -> Iterator[None]:
        """They stand still meanwhile."""
        self._signal(pids, signal.SIGSTOP)
        try:
            yield
        finally:
            self._signal(pids, signal.SIGCONT)

    @staticmethod
    def _signal(pids: tuple[int, ...], number: signal.Signals) -> None:
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, number)

    # -- the remote broker

    def save(self) -> dict[str, bytes]:
        """What the remote broker saves now, by file."""
        self.remote.save()
        return {str(file): file.read_bytes() for file in self.remote.store.iterdir()}

    def restore(self) -> None:
        """The remote broker is killed, and begins again with what it had saved some time ago."""
        self.remote.kill()
        for file, saved in self.older.items():
            Path(file).write_bytes(saved)
        self.remote.start()

    # -- disks and clock

    @property
    def has_disks(self) -> bool:
        """Whether this process may mount them."""
        return bool(self._mounted)

    @contextmanager
    def full(self) -> Iterator[None]:
        """The robot's disks are full meanwhile."""
        fillers = [disk / "filler" for disk in self.disks]
        for filler in fillers:
            with suppress(OSError), filler.open("wb", buffering=0) as file:
                while True:
                    file.write(bytes(1 << 16))
        try:
            yield
        finally:
            for filler in fillers:
                filler.unlink()

    def jump(self, seconds: float) -> None:
        """The robot's clock is ahead by so much from now on."""
        self._ahead[:] = struct.pack("q", int(seconds * 1e9))

    def _mount(self, disk: Path) -> None:
        words = ["mount", "-t", "tmpfs", "-o", f"size={_DISK},mode=700", "tmpfs", str(disk)]
        if subprocess.run(words, check=False, capture_output=True).returncode == 0:
            self._mounted.append(disk)

    def _make_clock(self) -> mmap.mmap:
        file = self._folder / "clock"
        file.write_bytes(bytes(8))
        (self._folder / "sitecustomize.py").write_text(_CLOCK)
        os.environ |= {"SOAK_CLOCK": str(file), "PYTHONPATH": str(self._folder)}
        with file.open("r+b") as opened:
            return mmap.mmap(opened.fileno(), 8)
