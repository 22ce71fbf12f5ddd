"""The lines of the audit: each has a hash of itself and of the line before, so a change shows.

A line is a JSON object ``{"n", "t", "what", "who", …, "h"}``; ``h`` is the first 32 hex digits of the SHA-256 of the
``h`` before and the line without its own. The first line of a file has the ``h`` before as ``after``, so it can be
verified without the file before. That the newest lines were cut off shows only by a :class:`Mark` that others noted.
"""

from collections.abc import Iterable
from hashlib import sha256
from typing import Any, NamedTuple

import msgspec

_DIGITS = 32
BEGIN = "0" * _DIGITS  # before the first line
_END = len(',"h":""}') + _DIGITS
_encode = msgspec.json.Encoder().encode


class Mark(NamedTuple):
    """The newest line of a chain: its number and its hash."""

    n: int = 0
    h: str = BEGIN


class Line(msgspec.Struct, frozen=True):
    """What every line has."""

    n: int
    h: str
    t: float = 0.0
    what: str = ""
    who: str = ""
    after: str | None = None

    @property
    def mark(self) -> Mark:
        return Mark(self.n, self.h)


_decode = msgspec.json.Decoder(Line).decode


def line(before: Mark, fields: dict[str, Any]) -> tuple[bytes, Mark]:
    """The line after ``before`` with these fields, without a line feed, and its mark."""
    number = before.n + 1
    body = _encode({"n": number, **fields})
    hash_ = _hash(before.h, body)
    return body[:-1] + b',"h":"' + hash_.encode() + b'"}', Mark(number, hash_)


def parse(raw: bytes) -> Line | None:
    """None: this is no line of an audit, perhaps half of one."""
    try:
        found = _decode(raw)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None
    return found if raw.endswith(b',"h":"' + found.h.encode() + b'"}') and len(found.h) == _DIGITS else None


def verify(lines: Iterable[bytes], marks: Iterable[Mark] = ()) -> str:
    """What is wrong with the first bad line; empty if all are whole, and none differs from ``marks``.

    ``lines`` may be the newest part of a chain: its first line, without ``after``, is believed.
    """
    noted = {mark.n: mark.h for mark in marks}
    before: Mark | None = None
    for raw in lines:
        found = parse(raw)
        problem = _problem(before, found, raw)
        if problem or found is None:
            return problem
        if noted.get(found.n, found.h) != found.h:
            return f"line {found.n} is not the one that was noted elsewhere: it was written anew"
        before = found.mark
    newest, last = 0 if before is None else before.n, max(noted, default=0)
    return "" if newest >= last else f"{_span(newest + 1, last)} missing: the end was cut off"


def _problem(before: Mark | None, found: Line | None, raw: bytes) -> str:
    if found is None:
        return f"line {1 if before is None else before.n + 1} was changed: it cannot be read"
    if before is None:
        if found.after is None and found.n != 1:
            return ""
        before = Mark(found.n - 1, BEGIN if found.after is None else found.after)
    elif found.n > before.n + 1:
        return f"{_span(before.n + 1, found.n - 1)} missing"
    elif found.n <= before.n:
        return f"after line {before.n} a line with the number {found.n} was inserted"
    if found.h != _hash(before.h, raw[:-_END] + b"}"):
        return f"line {found.n} was changed, or does not follow from the one before"
    return "" if found.after in (None, before.h) else f"line {found.n} begins a file that follows another line"


def _span(first: int, last: int) -> str:
    return f"line {first} is" if first == last else f"lines {first} to {last} are"


def _hash(before: str, body: bytes) -> str:
    return sha256(before.encode() + body).hexdigest()[:_DIGITS]
