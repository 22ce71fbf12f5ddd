"""The ``json`` module of a simulated board: CPython's, without what MicroPython does not take."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any


def _refuse(name: str) -> Any:
    raise ValueError(f"syntax error in JSON: {name}")


def loads(text: str | bytes | bytearray) -> Any:
    """ValueError for whatever is no JSON: NaN and infinity are none, and no depth is a way to crash the board."""
    try:
        decoded = text if isinstance(text, str) else str(text, "utf-8")
        return json.loads(decoded, parse_constant=_refuse)
    except RecursionError:
        raise ValueError("syntax error in JSON: too deep") from None


def load(stream: Any) -> Any:
    return loads(stream.read())


def dumps(value: Any, separators: tuple[str, str] | None = None) -> str:
    return json.dumps(value, separators=separators, allow_nan=False, ensure_ascii=False)


def dump(value: Any, stream: Any, separators: tuple[str, str] | None = None) -> None:
    stream.write(dumps(value, separators))


MODULE = SimpleNamespace(loads=loads, load=load, dumps=dumps, dump=dump)
