"""MQTT 3.1.1 packets written by hand, so that tests do not trust the code they check."""

from __future__ import annotations

from itertools import count

_names = count()


def packet(head: int, body: bytes) -> bytes:
    size, length = len(body), bytearray()
    while True:
        length.append(size % 128 | (128 if size >= 128 else 0))
        size //= 128
        if not size:
            return bytes((head, *length)) + body


def text(value: str | bytes) -> bytes:
    raw = value.encode() if isinstance(value, str) else value
    return len(raw).to_bytes(2, "big") + raw


def connect(
    user: str | None = "script",
    password: str | None = "right",
    *,
    level: int = 4,
    will: tuple[str, str] | None = None,
    client_id: str | None = None,
) -> bytes:
    flags = 2 | (0x80 if user is not None else 0) | (0x40 if password is not None else 0)
    flags |= 4 if will else 0
    properties = b"\x00" if level == 5 else b""
    texts = [text(f"t{next(_names)}" if client_id is None else client_id)]
    texts += [text(each) for each in (*(will or ()), user, password) if each is not None]
    return packet(0x10, text("MQTT") + bytes((level, flags, 0, 15)) + properties + b"".join(texts))


def publish(topic: str, payload: str | bytes, qos: int = 0, number: int = 1, *, retain: bool = False) -> bytes:
    raw = payload.encode() if isinstance(payload, str) else payload
    head = 0x30 | qos << 1 | int(retain)
    return packet(head, text(topic) + (number.to_bytes(2, "big") if qos else b"") + raw)
