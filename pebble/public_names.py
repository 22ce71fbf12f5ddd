"""Public names of modules in extensions: ``pebble.perception.tags`` is one module, under two names.

Only names that the documents promise are here.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.machinery import ModuleSpec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from types import CodeType, ModuleType

PUBLIC = {
    "pebble.cameras": "pebble.extensions.media.cameras",
    "pebble.script": "pebble.extensions.scripts.script",
    "pebble.scripts": "pebble.extensions.scripts.shipped",
    "pebble.perception": "pebble.extensions.scripts.perception",
    "pebble.simulation": "pebble.extensions.lab.simulation",
    "pebble.recordings": "pebble.extensions.recordings",
    "pebble.media": "pebble.extensions.media",
    "pebble.update": "pebble.extensions.install.update",  # pebble-slot and the release that it starts may differ in age
}


class PublicNames:
    """A finder of modules by their public names.

    It stands before Python's own finders, which would load a module of a public package a second time, by its path.
    """

    @staticmethod
    def find_spec(fullname: str, *_: object) -> ModuleSpec | None:
        public = ".".join(fullname.split(".", 2)[:2])  # its first two levels
        if public not in PUBLIC:
            return None
        from importlib.util import find_spec  # of use to public names only

        place = find_spec(PUBLIC[public] + fullname[len(public) :])
        if place is None:
            return None
        loader: Any = _SameModule(place)
        return ModuleSpec(fullname, loader, is_package=place.submodule_search_locations is not None)


class _SameModule:
    """A loader of a module under a second name."""

    def __init__(self, place: ModuleSpec) -> None:
        self._place = place
        self._spec: ModuleSpec | None = None  # of the module under its first name

    def create_module(self, _: ModuleSpec) -> ModuleType:
        module = import_module(self._place.name)
        self._spec = module.__spec__  # the import sets the one of the second name
        return module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._spec

    def get_code(self, _: str) -> CodeType | None:
        """Return the code that ``python -m`` runs."""
        loader: Any = self._place.loader
        code: CodeType | None = loader.get_code(self._place.name)
        return code


def install() -> None:
    """Make the public names importable."""
    if PublicNames not in sys.meta_path:
        sys.meta_path.insert(0, PublicNames)
