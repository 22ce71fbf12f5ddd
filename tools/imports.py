"""Imports every module of the project: what a version of a library lacks shows there first."""

from __future__ import annotations

import importlib
import pkgutil
import sys
import traceback

import pebble

#: Run by boards, by themselves when they are imported, or without the project.
LEFT_OUT = ("pebble.firmware", "pebble.examples")


def main() -> int:
    failed = 0
    for module in pkgutil.walk_packages(pebble.__path__, "pebble."):
        if module.name.startswith(LEFT_OUT) or module.name.endswith(".__main__"):
            continue
        try:
            importlib.import_module(module.name)
        except Exception:  # noqa: BLE001 - each one is of interest
            failed += 1
            traceback.print_exc(limit=-2)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
