"""The pure parts of the firmware run under CPython as they are; the one MicroPython module they know is put here."""

import sys
from types import ModuleType

micropython = ModuleType("micropython", "What of MicroPython's own module the pure parts use.")
micropython.const = lambda value: value  # type: ignore[attr-defined]
sys.modules.setdefault("micropython", micropython)
