"""Loads firmware files into isolated modules: two boards in one process share nothing."""

import __future__

import builtins
from collections.abc import Mapping
from functools import cache
from importlib.resources import as_file, files
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, Final

#: Builtins of CPython that MicroPython lacks
_ABSENT: Final = ("breakpoint", "compile", "copyright", "credits", "exit", "help", "input", "license", "quit", "vars")

_compiled: dict[tuple[str, int], CodeType] = {}


@cache
def firmware_root() -> Path:
    """Return the root folder of a board: ``firmware/`` of the checkout or of the installed package."""
    with as_file(files("pebble") / "firmware") as folder:
        return folder.resolve()


class FirmwareModules:
    """The modules of one board: firmware files from ``root``, and ``modules`` that are built into its MicroPython.

    The host's ``sys.modules`` is not used. Files are compiled once per process; a traceback names the real file and
    line. ``names`` are more builtins of the board, such as its ``open`` and ``print``.
    """

    def __init__(
        self, modules: Mapping[str, Any], names: Mapping[str, Any] | None = None, root: Path | None = None
    ) -> None:
        self._builtin = modules
        self._root = firmware_root() if root is None else root
        self._loaded: dict[str, ModuleType] = {}
        self._builtins = {name: value for name, value in vars(builtins).items() if name not in _ABSENT}
        self._builtins.update(names or {}, __import__=self._import)

    def module(self, name: str) -> Any:
        """Import and return the module ``name``; ImportError if the board has none."""
        if name in self._builtin:
            return self._builtin[name]
        if name in self._loaded:
            return self._loaded[name]
        parent, _, last = name.rpartition(".")
        package = self.module(parent) if parent else None
        place = self._root.joinpath(*name.split("."))
        path = place.with_suffix(".py")
        if path.is_file():
            module = self._execute(name, path)
        elif place.is_dir() and not parent:  # a package: our firmware has them only at the root
            module = self._add(name)
        else:
            raise ImportError(f"no module named '{name}'", name=name)
        if package is not None:
            setattr(package, last, module)
        return module

    def run(self, path: str) -> ModuleType:
        """Execute the file ``path`` (below the root) as ``__main__``, as a board does with its main.py."""
        return self._execute("__main__", self._root / path)

    def _execute(self, name: str, path: Path) -> ModuleType:
        module = self._add(name)
        module.__dict__.update(__builtins__=self._builtins, __file__=str(path))
        try:
            exec(_code(path), module.__dict__)  # noqa: S102 - our own firmware, as the board would execute it
        except BaseException:
            del self._loaded[name]
            raise
        return module

    def _add(self, name: str) -> ModuleType:
        self._loaded[name] = module = ModuleType(name)
        return module

    def _import(
        self, name: str, _globals: object = None, _locals: object = None, wanted: Any = (), level: int = 0
    ) -> Any:
        """Import as the board's ``__import__`` does."""
        if level:
            raise ImportError("firmware imports by full names: relative imports differ between ports", name=name)
        module = self.module(name)
        if not wanted:
            return self.module(name.partition(".")[0])
        for part in wanted:
            if not hasattr(module, part) and name not in self._builtin:
                self.module(f"{name}.{part}")
        return module


def _code(path: Path) -> CodeType:
    key = str(path), path.stat().st_mtime_ns
    if key not in _compiled:
        # annotations stay unevaluated, as in MicroPython
        flags = __future__.annotations.compiler_flag
        _compiled[key] = compile(path.read_bytes(), str(path), "exec", flags=flags, dont_inherit=True, optimize=0)
    return _compiled[key]
