"""Processes of tests that begin as forks of one that has imported their modules: importing is what takes time."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import sys
from multiprocessing.reduction import DupFd
from typing import Any

from pebble.runtime.parent import end_with_parent

_context = multiprocessing.get_context("forkserver")
_context.set_forkserver_preload(
    ["__main__", "tests.transports.frames.frames_peer", "tests.transports.zenoh.zenoh_actor", "pebble.runtime.hub"]
)


class Forked:
    """Runs ``main(*arguments)`` of a module; its standard input and output are pipes, as those of a `Popen`."""

    def __init__(self, module: str, *arguments: str) -> None:
        their_input, our_output = os.pipe()
        our_input, their_output = os.pipe()
        self._process = _context.Process(
            target=_run, args=(module, arguments, DupFd(their_input), DupFd(their_output)), daemon=True
        )
        self._process.start()
        os.close(their_input)
        os.close(their_output)
        self.stdin, self.stdout = os.fdopen(our_output, "w"), os.fdopen(our_input)

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    def poll(self) -> int | None:
        return self._process.exitcode

    def kill(self) -> None:
        self._process.kill()

    def wait(self, timeout: float) -> int | None:
        self._process.join(timeout)
        return self._process.exitcode


def _run(module: str, arguments: tuple[str, ...], standard_input: Any, standard_output: Any) -> None:
    end_with_parent()
    for number, pipe in enumerate((standard_input, standard_output)):
        os.dup2(pipe.detach(), number)
    sys.stdin, sys.stdout = os.fdopen(0, closefd=False), os.fdopen(1, "w", closefd=False)
    importlib.import_module(module).main(*arguments)
