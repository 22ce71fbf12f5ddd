"""Deliberate bugs: a text that is there once is replaced, in modules of this process or in a copy of files."""

from __future__ import annotations

import inspect
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any


@dataclass(frozen=True)
class Mutation:
    """``original``, which is there once in ``file`` (a module's name or a path), is replaced by ``mutated``."""

    file: str
    original: str
    mutated: str
    schedule: int = 0  # of seed 1, one that shows it: to begin there saves time
    kind: str = ""  # of the world that shows it, where there are several

    def text(self, path: Path) -> str:
        """What the file contains with the bug."""
        text = path.read_text()
        assert text.count(self.original) == 1, f"{self.file} has changed: adapt this mutation"
        return text.replace(self.original, self.mutated)


@contextmanager
def in_process(mutation: Mutation) -> Iterator[None]:
    """Replace the code of the functions that the bug changes in this process."""
    module = import_module(mutation.file)
    path = Path(inspect.getsourcefile(module) or "")
    codes = dict(_codes(compile(mutation.text(path), str(path), "exec")))
    functions = {name: function for name, function in _functions(module, module.__name__) if name in codes}
    saved = {name: function.__code__ for name, function in functions.items()}
    try:
        for name, function in functions.items():
            function.__code__ = codes[name]
        yield
    finally:
        for name, function in functions.items():
            function.__code__ = saved[name]


@contextmanager
def in_copy(mutation: Mutation, root: Path, *names: str) -> Iterator[Path]:
    """Yields a copy of these files and folders of ``root``, one of them with the bug."""
    with tempfile.TemporaryDirectory(prefix="pbl") as copy:
        for name in names:
            target = Path(copy, name)
            target.parent.mkdir(parents=True, exist_ok=True)
            if (root / name).is_dir():
                ignored = shutil.ignore_patterns("__pycache__")
                shutil.copytree(root / name, target, symlinks=True, ignore=ignored)
            else:
                shutil.copy(root / name, target)
        Path(copy, mutation.file).write_text(mutation.text(root / mutation.file))
        yield Path(copy)


def _codes(code: CodeType) -> Iterator[tuple[str, CodeType]]:
    """Every function in it, by its qualified name."""
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant.co_qualname, constant
            yield from _codes(constant)


def _functions(holder: ModuleType | type, module: str) -> Iterator[tuple[str, FunctionType]]:
    for value in list(vars(holder).values()):
        yield from _function(value, module)


def _function(value: Any, module: str) -> Iterator[tuple[str, FunctionType]]:
    if isinstance(value, property):
        value = value.fget
    if isinstance(value, classmethod | staticmethod):
        value = value.__func__
    if getattr(value, "__module__", None) != module:
        return
    if isinstance(value, FunctionType) and "<" not in value.__qualname__:
        if not (value.__closure__ or hasattr(value, "__wrapped__")):
            yield value.__qualname__, value
    elif isinstance(value, type):
        yield from _functions(value, module)
