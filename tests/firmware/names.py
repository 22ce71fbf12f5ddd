"""What a robot's names cost on its board: MicroPython keeps each name that its image does not know in memory, once.

In the interpreter in Node.js the stand-ins' names and those of its own modules are known already, so what the robot's
cost there is not that of a board. It is subtracted from the measurement, and this is added.
"""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

from tests.firmware.types import STUBS

_FIRST_POOL = 20  # names; each further pool has room for twice as many (py/qstr.c, qstr_add)
_POOL_HEAD = 28  # bytes: qstr_pool_t of a 32-bit port
_NAME = 7  # bytes in a pool: address, hash, length
_BLOCK = 16  # the heap gives nothing smaller


def cost(compiled: list[Path], port: str, in_place: bool) -> int:
    """Bytes of heap for the names in these .mpy files on a board of this port.

    ``in_place``: the files are in a ROM file system, and names stay there; only their addresses are in RAM.
    """
    own = {name for file in compiled for name in names_in(file.read_bytes())} - known(port)
    pools, size = 0, _FIRST_POOL
    room = 0
    while room < len(own):
        pools += -(-(_POOL_HEAD + size * _NAME) // _BLOCK) * _BLOCK
        room, size = room + size, size * 2
    return pools if in_place else pools + sum(len(name.encode()) + 1 for name in own)


def names_in(mpy: bytes) -> Iterator[str]:
    """The table of names at the beginning of a .mpy file (tools/mpy-tool.py, read_mpy); fixed ones have no text."""
    at = 4

    def number() -> int:
        nonlocal at
        value = 0
        while True:
            byte = mpy[at]
            at += 1
            value = value << 7 | byte & 127
            if not byte & 128:
                return value

    count = number()
    number()  # of constants
    for _ in range(count):
        head = number()
        if not head & 1:
            yield mpy[at : at + (head >> 1)].decode()
            at += (head >> 1) + 1


@functools.cache
def known(port: str) -> frozenset[str]:
    """Names in the image of a port: what its modules define, by their stubs."""
    found: set[str] = set()
    for file in (STUBS / port).rglob("*.pyi"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.FunctionDef):
                found.add(node.name)
                found.update(argument.arg for argument in node.args.kwonlyargs)
            elif isinstance(node, ast.ClassDef):
                found.add(node.name)
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                found.add(node.target.id)
        found.update((file.stem, file.parent.name))
    return frozenset(found)
