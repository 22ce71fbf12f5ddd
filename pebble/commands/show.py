"""A message as a person reads it: JSON in a readable form, bytes as a hex dump, nothing that upsets a terminal."""

from __future__ import annotations

import json
import re
from typing import Any

from pebble import codec
from pebble.transports import Message

_DUMPED = 32  # bytes of a binary payload that are shown
#: Binary payloads by their first bytes.
RECOGNISERS = {b"PBAT": "PBAT sound", b"PBVD": "PBVD picture", b"\xff\xd8": "JPEG picture"}
_control = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]").sub


def printable(text: str) -> str:
    """``text`` without control characters, which a stranger's payload could use to rewrite the terminal."""
    return _control(lambda found: f"\\u{ord(found[0]):04x}", text)


def body(payload: bytes, width: int) -> str:
    """JSON on one line where it fits and indented where not; text as it is; the rest as a hex dump."""
    if not payload:
        return "(empty: removes the kept copy)"
    plain = parsed(payload)
    if plain is not None:
        line = json.dumps(plain, ensure_ascii=False)
        return printable(line if len(line) <= width else json.dumps(plain, ensure_ascii=False, indent=2))
    known = recognised(payload)
    if known is None and _is_text(payload):
        return printable(payload.decode())
    return f"{known or 'binary'}, {len(payload)} bytes\n{hex_dump(payload[:_DUMPED], width)}"


def parsed(payload: bytes) -> Any:
    """The JSON value, or None for what is no JSON (or is ``null``)."""
    if codec.too_deep(payload):
        return None
    try:
        return json.loads(payload)
    except ValueError:
        return None


def recognised(payload: bytes) -> str | None:
    """What a binary payload is, by its first bytes."""
    return next((name for start, name in RECOGNISERS.items() if payload.startswith(start)), None)


def hex_dump(raw: bytes, width: int) -> str:
    """Offset, bytes and their ASCII, as many per line as fit."""
    per_line = 16 if width >= 76 else 8
    lines = []
    for start in range(0, len(raw), per_line):
        part = raw[start : start + per_line]
        text = "".join(chr(byte) if 0x20 <= byte < 0x7F else "." for byte in part)
        lines.append(f"  {start:04x}  {part.hex(' '):<{per_line * 3 - 1}}  {text}")
    return "\n".join(lines)


def headline(message: Message, now: float) -> str:
    """Topic, whether it is a kept copy, size, and how old the payload says it is. ``now``: epoch seconds."""
    parts = [printable(message.topic), f"{len(message.payload)} B", f"qos {int(message.qos)}"]
    if message.retain:
        parts.append("kept copy")
    elif message.keep:
        parts.append("to be kept")
    stamp = codec.stamp_of(parsed(message.payload))
    if stamp is not None:
        parts.append(f"stamped {age(now - stamp)}")
    return "  ".join(parts)


def age(seconds: float) -> str:
    """``12 ms ago``, ``3.2 s ago``, ``2 h ago``; clocks that differ show as ``… ahead``."""
    return f"{duration(abs(seconds))} {'ago' if seconds >= 0 else 'ahead'}"


def duration(seconds: float) -> str:
    """Seconds in a form a person reads at a glance."""
    if seconds < 1:
        return f"{seconds * 1000:.0f} ms"
    if seconds < 100:
        return f"{seconds:.1f} s"
    for size, unit in ((86400, "d"), (3600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def size(count: float) -> str:
    """Bytes: ``19 B``, ``1.2 kB``, ``3.4 MB``."""
    if count < 1000:
        return f"{count:.0f} B"
    return f"{count / 1e3:.1f} kB" if count < 1e6 else f"{count / 1e6:.1f} MB"


def _is_text(payload: bytes) -> bool:
    try:
        return not any(ord(character) < 9 for character in payload.decode())
    except UnicodeDecodeError:
        return False
