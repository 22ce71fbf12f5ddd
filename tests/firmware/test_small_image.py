"""The official MicroPython for the XIAO SAMD21 is a small one: its robots get by with what it has.

ports/samd/mcu/samd21/mpconfigmcu.h: MICROPY_CONFIG_ROM_LEVEL_BASIC_FEATURES, and SAMD21_EXTRA_FEATURES only where
MICROPY_HW_CODESIZE is 248 KB; on a XIAO it is 184. The type stubs are a bigger board's and the interpreter in Node.js
is a bigger build, so neither notices.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.extensions.install.flash.boards import FIRMWARE, SAMD21
from pebble.extensions.install.flash.sources import firmware_folder, modules

HAS = {
    "array",
    "binascii",
    "gc",
    "io",
    "json",
    "machine",
    "math",
    "micropython",
    "os",
    "random",
    "struct",
    "sys",
    "time",
}
#: Names of builtin methods and functions that only bigger images have.
LACKS = {"buffer", "center", "crc32", "deque", "OrderedDict", "partition", "rpartition", "splitlines", "hashlib"}
#: Loaded where there is more; the robots have something else otherwise.
FOR_BIGGER_IMAGES = {Path("common/usb.py")}

ROBOTS = [name for name, firmware in FIRMWARE.items() if firmware.board is SAMD21]


def names(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.Import | ast.ImportFrom):
            yield from (alias.name for alias in node.names)


def imported(tree: ast.Module) -> set[str]:
    found = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    found |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
    return {name.partition(".")[0] for name in found} - {"common", "wifi", *FIRMWARE}


@pytest.mark.parametrize("robot", ROBOTS)
def test_nothing_that_a_small_image_lacks(robot: str) -> None:
    for module in set(modules(FIRMWARE[robot])) - FOR_BIGGER_IMAGES:
        tree = ast.parse((firmware_folder() / module).read_text())
        assert imported(tree) <= HAS, module
        assert not LACKS & set(names(tree)), module
