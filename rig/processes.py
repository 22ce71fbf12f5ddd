"""The processes of a measurement or a demonstration, in a temporary folder, which end in order."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

from pebble.rig.broker import Broker, BrokerKind
from pebble.rig.programs import Program, Worker, Wrap, end_all, unchanged

#: In this order they end: robots while the brokers to which they report it still run, MCUs after what they move.
OPERATORS, ROBOTS, MCUS, BROKERS = range(4)

_LONGEST_FOLDER = 40  # characters: Unix sockets live below, and their paths end at 108 bytes

P = TypeVar("P", bound=Program)


class Processes:
    """Ends all of them with its ``with`` block, those of a kind at the same time; then deletes the folder.

    A subclass starts what it consists of in :meth:`start`; ``closing`` is closed before all processes end.
    """

    ends_s: ClassVar[tuple[float, ...]] = (4.0, 6.0, 2.0, 2.0)  # what is left of each kind after that is killed
    keep = False  # the folder

    def __init__(self, prefix: str = "pbl-") -> None:
        usual = tempfile.gettempdir()  # mkdtemp makes a 0700 folder in it
        self.folder = Path(tempfile.mkdtemp(prefix=prefix, dir=usual if len(usual) <= _LONGEST_FOLDER else "/tmp"))  # noqa: S108
        self.closing = ExitStack()
        self.workers: list[Worker] = []
        self._kinds: dict[Program, int] = {}

    def __enter__(self) -> Self:
        with ExitStack() as failed:
            failed.push(self)
            self.start()
            failed.pop_all()
        return self

    def start(self) -> None:
        """Called as the ``with`` block begins."""

    def __exit__(self, *_: object) -> None:
        self.closing.close()
        for kind, within_s in enumerate(self.ends_s):
            end_all([program for program, one in self._kinds.items() if one == kind], within_s)
        if not self.keep:
            shutil.rmtree(self.folder, ignore_errors=True)

    def add(self, program: P, kind: int) -> P:
        self._kinds[program] = kind
        return program

    def end(self, program: Program) -> None:
        """End one of them before the others."""
        end_all([program], self.ends_s[self._kinds.pop(program)])

    def unexpected_exits(self) -> list[str]:
        """The processes that should still run and do not, brokers first."""
        programs = sorted(self._kinds, key=lambda program: -self._kinds[program])
        return [f"{program.name} ended unexpectedly: see {program.log}" for program in programs if program.ended]

    def worker(self, name: str, module: str, *arguments: object, wrap: Wrap = unchanged) -> Worker:
        return self.command(name, wrap(python(module, *arguments)))

    def command(self, name: str, command: Sequence[str]) -> Worker:
        """A worker that is not a module."""
        self.workers.append(self.add(Worker(name, command, self.folder / f"{name}.log"), OPERATORS))
        return self.workers[-1]

    def robot(self, name: str, module: str, *arguments: object) -> Program:
        """One or more robots."""
        return self.add(Program(name, python(module, *arguments), self.folder / f"{name}.log"), ROBOTS)

    def broker(
        self, name: str = "broker", kind: BrokerKind = BrokerKind.MOSQUITTO, *, folder: Path | None = None, **more: Any
    ) -> Broker:
        """A broker that is starting: wait for it."""
        return self.add(Broker(name, kind, folder or self.folder, **more), BROKERS)


def python(module: str, *arguments: object) -> list[str]:
    """The command that runs a module."""
    return [sys.executable, "-m", module, *map(str, arguments)]
