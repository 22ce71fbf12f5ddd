"""The small built-in modules of a simulated board: ``sys``, ``os``, ``gc``, ``micropython``, ``random``."""

from __future__ import annotations

import errno
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

from pebble.simulation.micropython.console import Input, Output
from pebble.simulation.micropython.faults import failure

if TYPE_CHECKING:
    from pebble.simulation.micropython.board import Board

_VERSION: Final = (1, 29, 0)


def sys_module(board: Board) -> SimpleNamespace:
    version = ".".join(map(str, _VERSION))
    console, stdio_bytes = board.console, board.port.stdio_bytes
    return SimpleNamespace(
        stdin=Input(console, buffer=stdio_bytes),
        stdout=Output(console, buffer=stdio_bytes),
        stderr=Output(console, buffer=stdio_bytes),
        platform=board.port.platform,
        implementation=SimpleNamespace(name="micropython", version=_VERSION, _machine=board.port.board),
        version=f"3.4.0; MicroPython v{version}",
        version_info=(3, 4, 0),
        byteorder="little",
        maxsize=(1 << 31) - 1,
        path=["", "/lib"],
        print_exception=lambda error, _file=None: board.print(repr(error)),
    )


def os_module(board: Board) -> SimpleNamespace:
    def stat(path: str) -> tuple[int, ...]:
        if path not in board.files:
            raise failure(errno.ENOENT)
        return (0x8000, 0, 0, 0, 0, 0, len(board.files[path]), 0, 0, 0)

    return SimpleNamespace(
        urandom=board.random.randbytes,
        stat=stat,
        listdir=lambda folder="/": [path.removeprefix(folder) for path in board.files if path.startswith(folder)],
        uname=lambda: SimpleNamespace(sysname=board.port.platform, machine=board.port.board, release="1.29.0"),
    )


def _nothing(*_arguments: Any) -> int:
    return 0


#: Memory is the host's; how much a real board needs is measured on MicroPython itself
GC: Final = SimpleNamespace(
    collect=_nothing,
    enable=_nothing,
    disable=_nothing,
    threshold=_nothing,
    mem_free=_nothing,
    mem_alloc=_nothing,
)


def micropython_module(board: Board) -> SimpleNamespace:
    def kbd_intr(character: int) -> None:
        board.console.interrupt = character

    return SimpleNamespace(
        const=lambda value: value,
        kbd_intr=kbd_intr,
        mem_info=_nothing,
        alloc_emergency_exception_buf=_nothing,
        heap_lock=_nothing,
        heap_unlock=_nothing,
        opt_level=_nothing,
    )


def random_module(board: Board) -> SimpleNamespace:
    """CPython's generator, one per board: runs repeat."""
    own = board.random
    return SimpleNamespace(
        seed=own.seed,
        random=own.random,
        uniform=own.uniform,
        getrandbits=own.getrandbits,
        randint=own.randint,
        randrange=own.randrange,
        choice=own.choice,
    )
