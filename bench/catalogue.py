"""All comparisons, in the order of the report. A module is imported when one of its comparisons is needed."""

from __future__ import annotations

from importlib import import_module
from typing import Final

from pebble.bench.comparison import Comparison
from pebble.errors import PebbleError

#: The module of each comparison, which has it as a constant of the same name: CONTROL_NULL.
MODULES: Final = {
    "control": "control",
    "control-null": "control",
    "bridge": "bridge",
    "bridge-profile": "bridge",
    "bridge-null": "bridge",
    "startup": "startup",
    "cost": "cost",
    "frames": "frames",
    "frames-null": "frames",
    "video": "wire",
    "sound": "wire",
    "estop": "estop",
    "fleet": "fleet",
    "traffic": "traffic",
    "page": "page",
    "impair": "impair.trials",
}


def find(name: str) -> Comparison:
    """Raises KeyError for an unknown name."""
    found: Comparison = getattr(import_module(f"pebble.bench.{MODULES[name]}"), name.upper().replace("-", "_"))
    return found


def commands() -> list[str]:
    """What follows ``pebble bench``: a mode such as ``control-null`` is an option of another one."""
    others = ("-null", "-profile", "impair")
    return [name for name in MODULES if not name.endswith(others)]


def reported() -> list[Comparison]:
    """The comparisons of the report."""
    return [one for one in map(find, MODULES) if one.reported is not None]


def chosen(names: list[str]) -> list[Comparison]:
    """The comparisons of these names, in the report's order; without names all that this user may run.

    Raises PebbleError for unknown names.
    """
    known = {one.name: one for one in reported()}
    if unknown := [name for name in names if name not in known]:
        raise PebbleError(f"there is no {', '.join(unknown)} in the report: there are {', '.join(known)}")
    return [one for one in known.values() if (one.name in names if names else not one.needs_more_rights)]
