"""Plants faults in how the bridge passes stops on, and has random schedules find them.

``python -m tests.robot.lockstep.planted NUMBER`` prints how many schedules find each.
"""

from __future__ import annotations

import inspect
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from types import ModuleType
from typing import Any
from unittest.mock import patch

from pebble.services.mqtt_bridge import passed_stops
from pebble.services.mqtt_bridge import service as bridge_module
from pebble.services.mqtt_bridge.stop_connection import Copies
from tests.robot.lockstep.schedules import ENGINE
from tests.robot.lockstep.two_owners import MIXES

#: One change each in passed_stops.py; with an empty one the copies of nameless stops are not recognised.
FAULTS: dict[str, tuple[str, str]] = {
    "one owner's confirmation ends it for all": (
        "self.pending = None\n\n\nclass",
        "self.pending.ended.append(1)\n        if self.pending and self.pending.ended:\n"
        "            self.pending = None\n\n\nclass",
    ),
    "an unsaved state that names it ends it": (" and (state.persisted is not False or not state.latched)", ""),
    "a reset seen later ends it": (
        "self.freed_at = now if",
        "self.pending = None if before.latched else self.pending\n            self.freed_at = now if",
    ),
    "an older stop's repetition replaces the newer": (" and not newer and", " and"),
    "names are forgotten over a reset": ("            if ended:", "            if False:"),
    "a nameless copy is not recognised": ("", ""),
    "pending is forgotten at a new boot": (
        "        self.withdrawn_at = None\n        #",
        "        self.pending = None if before is not None and before.boot != state.boot else self.pending\n"
        "        self.withdrawn_at = None\n        #",
    ),
    "an owner that is withdrawn has no end": (" if self._owners[key].withdrawn_at is None", ""),
    "the repetition names no owner": ('"why": command.why or UNSET}', '"why": command.why or UNSET, "owner": UNSET}'),
}


@cache
def _module(fault: str) -> Any:
    old, new = FAULTS[fault]
    text = inspect.getsource(passed_stops)
    assert text.count(old) == 1, fault
    text = text.replace(old, new)
    if "ended.append" in new:  # stops of one press share the list
        text = text.replace("    at: float\n", "    at: float\n    ended: list[int]\n")
        text = text.replace("Pending(stop, first, now)", "Pending(stop, first, now, shared)")
        text = text.replace("        now, name =", "        shared: list[int] = []\n        now, name =")
    if '"owner": UNSET' in new:
        text = text.replace("**(kept | fields)", "**(fields | kept)")
    module = ModuleType("planted")
    exec(compile(text, fault, "exec"), vars(module))
    return module


@contextmanager
def planted(fault: str) -> Iterator[None]:
    """The bridge has the fault meanwhile."""
    if not FAULTS[fault][0]:
        with patch.object(Copies, "is_copy", lambda *_arguments, **_options: False):
            yield
    else:
        with patch.object(bridge_module, "PassedStops", _module(fault).PassedStops):
            yield


def search(fault: str, most: int) -> str:
    """Return how many schedules of stops, the last of the mixes, find the fault, and by which rule."""
    with ENGINE.world("owners") as world, planted(fault):
        for number in range(most):
            if rule := ENGINE.violation(world, ENGINE.draw("owners", 1, MIXES * number + MIXES - 1)):
                return f"{number + 1:>6} {fault}: {rule}"
    return f"     - {fault}: not found"


if __name__ == "__main__":
    logging.disable(logging.CRITICAL)
    for planted_fault in sys.argv[2:] or FAULTS:
        sys.stdout.write(search(planted_fault, int(sys.argv[1])) + "\n")
        sys.stdout.flush()
