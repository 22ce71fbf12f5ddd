"""Turns the bytes of a terminal into the names of keys. Pure: times are passed in."""

ESCAPE, SPACE, END = "escape", "space", "end"
UP, DOWN, LEFT, RIGHT = "up", "down", "left", "right"

ALONE_S = 0.05  # an escape byte with nothing behind it for so long is the Escape key
_ESC = 0x1B
_LONGEST = 32  # bytes of a sequence that are remembered
_ARROWS = {ord("A"): UP, ord("B"): DOWN, ord("C"): RIGHT, ord("D"): LEFT}
_NAMED = {ord(" "): SPACE, 0x04: END}  # Ctrl-D


class KeyDecoder:
    """Feed it what was read; arrow keys, function keys and the Escape key all begin with the same byte."""

    def __init__(self) -> None:
        self._waiting = b""  # the beginning of a sequence
        self._since = 0.0

    @property
    def due(self) -> float | None:
        """When to call :meth:`feed` although nothing was read; None: not before something is."""
        return self._since + ALONE_S if self._waiting else None

    def feed(self, data: bytes, now: float) -> list[str]:
        """The keys in ``data``, in order: a printable character in lower case, or one of the names above."""
        keys = self._flush() if self._waiting and now >= self._since + ALONE_S else []
        if not data:
            return keys
        data, self._waiting = self._waiting + data, b""
        while data:
            length, key = _first(data)
            if not length:
                self._waiting, self._since = (
                    data if len(data) <= _LONGEST else data[:2],
                    now,
                )  # its end is still awaited
                break
            if key is not None:
                keys.append(key)
            data = data[length:]
        return keys

    def _flush(self) -> list[str]:
        """What waited in vain for the rest of a sequence."""
        alone, self._waiting = self._waiting == bytes([_ESC]), b""
        return [ESCAPE] if alone else []


def _first(data: bytes) -> tuple[int, str | None]:
    """How many bytes the first key has, and its name; 0 bytes: more is needed, no name: a key without a meaning."""
    if data[0] != _ESC:
        if data[0] >= 0xC0:  # the first byte of a character of several, by UTF-8
            length = 2 + (data[0] >= 0xE0) + (data[0] >= 0xF0)
            return (length, data[:length].decode(errors="ignore").lower() or None) if len(data) >= length else (0, None)
        return 1, _NAMED.get(data[0]) or (chr(data[0]).lower() if 0x20 < data[0] < 0x7F else None)
    if len(data) == 1:
        return 0, None
    if data[1] in b"[O":
        return _sequence(data)
    return 1, ESCAPE  # Escape may be an emergency stop: Alt and a character count as Escape and that character


def _sequence(data: bytes) -> tuple[int, str | None]:
    """``ESC O A`` or ``ESC [ parameters A``; the Linux console has ``ESC [ [ A`` for its first function keys."""
    if data[1:2] == b"O" or data[2:3] == b"[":
        end = 2 if data[1:2] == b"O" else 3
    else:
        end = next((at for at in range(2, len(data)) if 0x40 <= data[at] <= 0x7E), len(data))
    if end >= len(data):
        return 0, None
    return end + 1, _ARROWS.get(data[end]) if end == 2 else None
