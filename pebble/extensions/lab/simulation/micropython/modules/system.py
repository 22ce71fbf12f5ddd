"""The small built-in modules of a simulated board: ``sys``, ``os``, ``gc``, ``micropython``, ``random``, ``json``."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

from pebble.extensions.lab.simulation.micropython.console import Input, Output

if TYPE_CHECKING:
    from pebble.extensions.lab.simulation.micropython.board import Board

_VERSION: Final = (1, 29, 0)


def sys_module(board: Board) -> SimpleNamespace:
    console, stdio_bytes = board.console, board.port.stdio_bytes
    return SimpleNamespace(
        stdin=Input(console, buffer=stdio_bytes),
        stdout=Output(console, buffer=stdio_bytes),
        implementation=SimpleNamespace(name="micropython", version=_VERSION, _machine=board.port.board),
    )


def os_module(board: Board) -> SimpleNamespace:
    files = board.files
    return SimpleNamespace(
        urandom=board.random.randbytes,
        listdir=files.listdir,
        rename=files.rename,
    )


#: Without effect: memory is measured on MicroPython itself
GC: Final = SimpleNamespace(collect=lambda: None)


def micropython_module(board: Board) -> SimpleNamespace:
    def kbd_intr(character: int) -> None:
        board.console.interrupt = character

    return SimpleNamespace(const=lambda value: value, kbd_intr=kbd_intr)


def random_module(board: Board) -> SimpleNamespace:
    """Return the module ``random`` with a generator of its own for each board, so that runs are repeatable."""
    return SimpleNamespace(getrandbits=board.random.getrandbits)


def _refuse(name: str) -> Any:
    raise ValueError(f"syntax error in JSON: {name}")


def _loads(text: str | bytes | bytearray) -> Any:
    """Return the value of JSON text. Raises ValueError for anything else, also NaN, infinity and too deep nesting."""
    try:
        decoded = text if isinstance(text, str) else str(text, "utf-8")
        return json.loads(decoded, parse_constant=_refuse)
    except RecursionError:
        raise ValueError("syntax error in JSON: too deep") from None


def _load(stream: Any) -> Any:
    return _loads(stream.read())


def _dumps(value: Any, separators: tuple[str, str] | None = None) -> str:
    return json.dumps(value, separators=separators, allow_nan=False, ensure_ascii=False)


def _dump(value: Any, stream: Any, separators: tuple[str, str] | None = None) -> None:
    stream.write(_dumps(value, separators))


#: ``json``: CPython's, without what MicroPython refuses
JSON: Final = SimpleNamespace(loads=_loads, load=_load, dumps=_dumps, dump=_dump)
