"""What a program of a robot is."""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path

from msgspec import Struct


class Stage(IntEnum):
    """What stops together; the highest first."""

    FABRIC = 0  # what the others talk through
    NEWS = 1  # what tells the world how the others ended
    DEVICE = 2  # what owns hardware
    LINK = 3  # what talks to other machines


class Program(Struct, frozen=True):
    """One process: its name in logs and status, and the module that it runs with ``arguments``, as ``python -m`` would.

    The launcher imports the module, or all modules of the package, before it forks: importing must do nothing.
    """

    name: str
    module: str
    arguments: tuple[str, ...]
    stage: Stage
    told: bool = False  # its stdin is the launcher's news; the others have none
    asks: bool = False  # may say which on-demand programs are wanted
    on_demand: bool = False  # runs only while it is wanted
    preloaded: bool = True  # False: it imports what only few need, and that much memory is not for all to carry
    environment: dict[str, str] = {}
    folder: Path | None = None  # to run in; None: the launcher's
    stop_timeout_s: float = 10.0  # of an on-demand program that is not wanted any more; then it is killed
