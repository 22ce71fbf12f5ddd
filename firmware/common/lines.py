"""The text protocol goob_base_v1 as a motor board speaks it: bytes in, commands and lines out. Pure.

``M <left> <right>``, ``L <b> <g> <r>``, ``F <b> <g> <r> <period_s>``. The first letter of a line decides, in either
case; of up to five numbers the needed ones are taken and the rest of the line is not looked at.
"""

from micropython import const

_LIMIT = const(256)  # bytes of a line without its LF; the longest that makes sense has under 60
_NUMBERS = const(5)
_RING = const(128)  # bytes for the host
_LF = const(10)
_BLANK = const(32)
_MANY = const(100_000_000)  # nine digits are enough, and still a small integer


class Lines:
    """``take`` the host's bytes: ``obey(letter, numbers)`` is called for each good command, with the letter's code and
    five floats. What is ``say`` and the answers wait in ``ring``: ``used`` bytes from ``first`` on, around its end.
    """

    def __init__(self, obey) -> None:
        self.numbers = [0.0] * _NUMBERS
        self.ring = bytearray(_RING)
        self.first = self.used = 0
        self._obey = obey
        self._line = bytearray(_LIMIT)
        self._length = 0
        self._skipping = False

    def say(self, line: bytes) -> None:
        """Without its CR LF. It is lost as a whole if the host reads too slowly."""
        size = len(line) + 2
        if size > _RING - self.used:
            return
        at = self.first + self.used
        for byte in line:
            self.ring[at % _RING] = byte
            at += 1
        self.ring[at % _RING] = 13
        self.ring[(at + 1) % _RING] = _LF
        self.used += size

    def take(self, byte: int) -> None:
        if byte == _LF:
            if not self._skipping:
                self._end(self._length)
            self._skipping = False
            self._length = 0
        elif self._length < _LIMIT:
            self._line[self._length] = byte
            self._length += 1
        elif not self._skipping:
            self._skipping = True
            self.say(b"WARN line too long")

    def _end(self, length: int) -> None:
        line = self._line
        at = _after(line, 0, length, True)
        if at == length:
            return
        letter = line[at]
        if 97 <= letter <= 122:
            letter -= 32
        wanted = 2 if letter == 77 else 3 if letter == 76 else 4 if letter == 70 else 0  # M, L, F
        if not wanted:
            self.say(b"ERR unknown command")
            return
        count = 0
        while count < _NUMBERS:
            at = _after(line, _after(line, at, length, False), length, True)
            if at == length:
                break
            self.numbers[count] = number(line, at, length)
            count += 1
        if count < wanted:
            self.say(b"ERR %c needs %d values" % (letter, wanted))
            return
        self._obey(letter, self.numbers)
        self.say(b"OK %c" % letter)


def _after(line: bytearray, at: int, end: int, blanks: bool) -> int:
    """Where the run of blanks, or of anything else, that starts at ``at`` is over."""
    while at < end and (line[at] == _BLANK or 9 <= line[at] <= 13) == blanks:
        at += 1
    return at


def number(line: bytes | bytearray, at: int, end: int) -> float:
    """The decimal number at ``at``. What follows it does not count; anything else, nan and inf too, is 0."""
    negative = line[at] == 45
    if negative or line[at] == 43:
        at += 1
    digits = 0
    scale = 0  # 0: left of the point; else 10 ** digits right of it
    while at < end:
        byte = line[at]
        if byte == 46 and not scale:
            scale = 1
        elif not 48 <= byte <= 57:
            break
        elif digits < _MANY and scale < _MANY:
            digits = digits * 10 + byte - 48
            scale *= 10
        at += 1
    value = digits / (scale or 1)
    return -value if negative else value


def clamp(value: float, lowest: float) -> float:
    """``value`` within ``lowest`` .. 1."""
    return lowest if value < lowest else 1.0 if value > 1.0 else value
