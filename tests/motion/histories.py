"""Random histories of stops, resets and drives: ``python -m tests.kit.schedules motion``."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

from tests.kit.schedules import Engine, Steps
from tests.motion.world import CORES, LAYOUTS, World

LENGTH = 100  # steps of a history

_EVERYTHING = {
    "wait": 14, "deliver": 16, "all": 10, "duplicate": 3, "lose": 2, "deaf": 2, "retain": 2, "subscribe": 2,
    "restore": 1, "drive": 6, "release": 3, "halt": 1, "press": 3, "nameless": 1, "see": 10, "reset": 3,
    "look_and_reset": 3, "send": 4, "end_sender": 1, "start_run": 3, "script": 8, "rogue": 2, "end_run": 1,
    "restart_manager": 1, "work": 5, "apply": 3, "write": 9, "cut": 2, "cut_all": 1, "cut_while_writing": 1,
    "start": 6, "unwritable": 1, "corrupt": 1, "remove": 1,
}  # fmt: skip
_DRIVING = {
    "wait": 30, "deliver": 10, "all": 40, "duplicate": 2, "lose": 2, "deaf": 1, "retain": 1, "subscribe": 1,
    "drive": 6, "release": 4, "halt": 1, "press": 1, "send": 1, "see": 4, "look_and_reset": 3, "start_run": 6,
    "script": 24, "rogue": 3, "end_run": 1, "work": 4, "apply": 3, "write": 2, "cut": 1, "start": 2, "restart": 4,
    "restart_manager": 2, "end_sender": 1,
}  # fmt: skip
_RESETTING = {
    "wait": 24, "deliver": 6, "all": 34, "drive": 24, "release": 2, "press": 4, "nameless": 3, "send": 3, "see": 10,
    "reset": 2, "look_and_reset": 16, "retain": 1, "subscribe": 1, "restore": 1, "write": 6, "cut": 1, "start": 2,
}  # fmt: skip
_SAVING = {
    "wait": 12, "deliver": 6, "all": 16, "duplicate": 3, "press": 5, "send": 4, "see": 16, "reset": 3,
    "look_and_reset": 9, "write": 30, "cut": 5, "cut_all": 2, "cut_while_writing": 2, "start": 10, "drive": 4,
    "unwritable": 2, "corrupt": 1, "remove": 1, "restart_manager": 1, "lose": 1, "deaf": 1, "retain": 1, "nameless": 1,
}  # fmt: skip
_CONTROL = {
    "wait": 30, "deliver": 6, "all": 30, "duplicate": 3, "lose": 1, "hold": 14, "let_go": 3, "learn": 8, "steer": 20,
    "control": 8, "signed": 2, "drive": 5, "release": 3, "halt": 1, "press": 1, "look_and_reset": 4, "start_run": 4,
    "script": 8, "rogue": 1, "retain": 1, "subscribe": 1, "restart": 1,
}  # fmt: skip


def _perform(cores: Any, history: Steps) -> None:
    layout, steps = history
    world = World(layout, cores)
    world.perform(steps)
    world.rest()


ENGINE = Engine(
    mixes=(_EVERYTHING, _DRIVING, _CONTROL, _RESETTING, _SAVING, _CONTROL),
    length=LENGTH,
    layouts=len(LAYOUTS),
    world=lambda _kind: nullcontext(CORES),
    perform=_perform,
    schedules=3000,
    per_world=1000,
)
