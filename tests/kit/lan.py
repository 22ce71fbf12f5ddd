"""Machines on a switch, each a network namespace with an address of its own; programs are started there. Needs root."""

from __future__ import annotations

import itertools
import os
import shutil
import subprocess
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from pebble.extensions.operator.places import SBIN
from tests.support import ROOT, Child, until

NET = "10.78.0"


class Machine:
    def __init__(self, address: str, stack: ExitStack) -> None:
        self.address, self._stack = address, stack
        self._holder = Child(["unshare", "--net", "sleep", "infinity"])
        stack.callback(self._holder.wait, 10)
        stack.callback(self._holder.kill)
        space = Path(f"/proc/{self.pid}/ns/net")
        assert until(lambda: space.readlink() != Path("/proc/self/ns/net").readlink())
        self.ip("link set lo up")

    @property
    def pid(self) -> int:
        return self._holder.pid

    def inside(self, command: Sequence[str]) -> list[str]:
        return ["nsenter", f"--net=/proc/{self.pid}/ns/net", "--", *command]

    def ip(self, line: str) -> None:
        program = shutil.which("ip", path=f"{os.environ['PATH']}:{SBIN}")
        assert program is not None
        subprocess.run(self.inside([program, *line.split()]), check=True, timeout=10)

    def start(self, command: Sequence[str], **options: Any) -> Child:
        """A program on it, which is killed at the end."""
        process = Child(self.inside(command), cwd=ROOT, **options)
        self._stack.callback(process.wait, 10)
        self._stack.callback(process.kill)
        return process


class Lan:
    def __init__(self, stack: ExitStack) -> None:
        self._stack, self._numbers = stack, itertools.count(1)
        self._switch = Machine("", stack)
        for line in ("link add br0 type bridge", "link set br0 up"):
            self._switch.ip(line)

    def machine(self) -> Machine:
        number = next(self._numbers)
        made = Machine(f"{NET}.{number}", self._stack)
        self._switch.ip(f"link add port{number} type veth peer name eth0 netns {made.pid}")
        self._switch.ip(f"link set port{number} master br0 up")
        made.ip(f"address add {made.address}/24 dev eth0")
        made.ip("link set eth0 up")
        return made
