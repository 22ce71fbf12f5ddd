"""A decoder of a terminal's bytes to names of keys. Pure: times are passed in."""

import re

ESCAPE, SPACE, END = "escape", "space", "end"
UP, DOWN, LEFT, RIGHT = "up", "down", "left", "right"

ALONE_S = 0.05  # an escape byte with nothing behind it for so long is the Escape key
_LONGEST = 32  # bytes of a sequence that are remembered
#: One whole key: a sequence (the Linux console has ``ESC [ [ A`` for its first function keys), Escape before anything
#: else, because it may be an emergency stop (so Alt and a character are two keys), or a character of UTF-8.
_KEY = re.compile(
    rb"\x1b(?:\[\[.|\[(?!\[)[^@-~]*[@-~]|O.|(?=[^\[O]))|[\xf0-\xff]...|[\xe0-\xef]..|[\xc0-\xdf].|[^\x1b\xc0-\xff]",
    re.DOTALL,
)
_ARROWS = {b"A": UP, b"B": DOWN, b"C": RIGHT, b"D": LEFT}
_NAMED = {b"\x1b": ESCAPE, b" ": SPACE, b"\x04": END, b"\x1a": END}  # Ctrl-D, Ctrl-Z
_NAMED |= {begin + end: arrow for begin in (b"\x1b[", b"\x1bO") for end, arrow in _ARROWS.items()}


class KeyDecoder:
    """A decoder that keeps an incomplete key, because arrow keys, function keys and Escape begin with the same byte."""

    def __init__(self) -> None:
        self._waiting = b""  # the beginning of a sequence
        self._since = 0.0

    @property
    def due(self) -> float | None:
        """Return when to call :meth:`feed` without new bytes, to report a lone Escape.

        None: nothing is pending.
        """
        return self._since + ALONE_S if self._waiting else None

    def feed(self, data: bytes, now: float) -> list[str]:
        """Return the keys in ``data``, in order: a printable character in lower case, or a name such as ESCAPE."""
        keys: list[str] = []
        if self._waiting and now >= self._since + ALONE_S:  # the rest of a sequence has not come
            if self._waiting == b"\x1b":
                keys.append(ESCAPE)
            self._waiting = b""
        data, at = self._waiting + data, 0
        while (key := _KEY.match(data, at)) is not None:
            keys += _names(key[0])
            at = key.end()
        incomplete = data[at:]
        if incomplete != self._waiting:
            is_too_long = len(incomplete) > _LONGEST  # its first two bytes suffice to find its end
            self._waiting = incomplete[:2] if is_too_long else incomplete
            self._since = now
        return keys


def _names(key: bytes) -> list[str]:
    """Return the name of a key in a list, which is empty for a key without a meaning."""
    if key in _NAMED:
        return [_NAMED[key]]
    text = "" if key[0] == 0x1B else key.decode(errors="ignore").lower()
    return [text] if text.isprintable() and text.strip() else []
