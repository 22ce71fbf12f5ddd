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


def verify(lines: Iterable[bytes], mark: Mark | None = None) -> str:
    """What is wrong with the first bad line; empty if all are whole, and if ``mark`` is among them or older.

    A part of a chain may be verified: its first line, without ``after``, is believed.
    """
    before: Mark | None = None
    oldest: int | None = None
    for raw in lines:
        found = parse(raw)
        problem = _problem(before, found, raw)
        if problem or found is None:
            return problem
        if mark is not None and found.n == mark.n and found.h != mark.h:
            return f"line {found.n} is not the one that was noted elsewhere: it was written anew"
        oldest = found.n if oldest is None else oldest
        before = found.mark
    newest = 0 if before is None else before.n
    if mark is not None and newest < mark.n:
        lost = f"line {mark.n} is" if mark.n == newest + 1 else f"lines {newest + 1} to {mark.n} are"
        return f"{lost} missing: the end was cut off"
    return ""


def _problem(before: Mark | None, found: Line | None, raw: bytes) -> str:
    if found is None:
        return f"line {1 if before is None else before.n + 1} was changed: it cannot be read"
    if before is None:
        if found.after is None and found.n != 1:
            return ""
        before = Mark(found.n - 1, BEGIN if found.after is None else found.after)
    elif found.n > before.n + 1:
        gap = f"line {before.n + 1} is" if found.n == before.n + 2 else f"lines {before.n + 1} to {found.n - 1} are"
        return f"{gap} missing"
    elif found.n <= before.n:
        return f"after line {before.n} a line with the number {found.n} was inserted"
    if found.h != _hash(before.h, raw[:-_END] + b"}"):
        return f"line {found.n} was changed, or does not follow from the one before"
    return "" if found.after in (None, before.h) else f"line {found.n} begins a file that follows another line"


def _hash(before: str, body: bytes) -> str:
    return sha256(before.encode() + body).hexdigest()[:_DIGITS]
