"""Imports once what all programs need: what is in memory before a fork, parent and children share."""

from __future__ import annotations

import gc
import logging
import os
from collections.abc import Iterable, Iterator
from importlib import import_module
from pkgutil import iter_modules

log = logging.getLogger(__name__)


def preload(modules: Iterable[str]) -> None:
    """Import ``modules``, and what lies in those that are packages. What cannot be imported is left to the child."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # else numpy starts threads, and no fork may follow
    for name in modules:
        try:
            for part in _parts(name):
                import_module(part)
        except Exception:  # a broken program is its own trouble: the process that runs it says what is wrong
            log.debug("%s cannot be imported", name, exc_info=True)
    gc.collect()
    gc.freeze()  # a collection writes into every object it looks at, and a page that is written to is no longer shared


def _parts(name: str) -> Iterator[str]:
    yield name
    for found in iter_modules(getattr(import_module(name), "__path__", ())):
        if found.name != "__main__":
            yield f"{name}.{found.name}"
