"""The text protocol goob_base_v1 on a motor board: bytes in, commands and lines out. Pure.

``M <left> <right>``, ``L <b> <g> <r>``, ``F <b> <g> <r> <period_s>``. The first letter of a line is the command, in
either case; up to five numbers are read, and the rest of the line is ignored.
"""

from micropython import const

from common.ticks import diff

_LIMIT = const(256)  # bytes of a line without its LF; the longest useful one has under 60
_SILENCE_MS = const(200)  # a host writes a line at once; one that is unfinished by then is from a killed host
_NUMBERS = const(5)
_RING = const(128)  # bytes for the host
_LF = const(10)
_BLANK = const(32)
_MANY = const(100_000_000)  # nine digits are enough, and still a small integer


class Lines:
    """The state of the protocol. Pass the host's bytes to ``take``, and call ``rest`` when there are none.

    ``act(letter, numbers)`` is called for each valid command, with the letter's code and five floats. ``length`` is the
    length of the unfinished line. Answers and lines of ``put`` are queued in ``ring``: ``used`` bytes from ``first``
    on, wrapping around its end.
    """

    def __init__(self, act) -> None:
        self.numbers = [0.0] * _NUMBERS
        self.ring = bytearray(_RING)
        self.first = self.used = 0
        self._act = act
        self._line = bytearray(_LIMIT)
        self.length = 0
        self._skipping = False  # the end of a line that is too long
        self._silent_at: int | None = None  # since when no byte was received

    def put(self, line: bytes) -> None:
        """Queue a line, without its CR LF. A line that does not fit is dropped."""
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
        self._silent_at = None
        if byte == _LF:
            if not self._skipping:
                self._end(self.length)
            self._skipping = False
            self.length = 0
        elif self.length < _LIMIT:
            self._line[self.length] = byte
            self.length += 1
        elif not self._skipping:
            self._skipping = True
            self.put(b"WARN line too long")

    def rest(self, now: int) -> None:
        """Drop an unfinished line after 200 ms without a byte. A pause in reading does not count."""
        if self._silent_at is None:
            self._silent_at = now
        elif self.length and diff(now, self._silent_at) >= _SILENCE_MS:
            self.length = 0
            self._skipping = False

    def _end(self, length: int) -> None:
        line = self._line
        at = _after(line, 0, length, True)  # the blanks before the letter
        if at == length:
            return
        letter = line[at]
        if 97 <= letter <= 122:  # a..z, made A..Z
            letter -= 32
        wanted = 2 if letter == 77 else 3 if letter == 76 else 4 if letter == 70 else 0  # values of M, L, F; 0: unknown
        if not wanted:
            self.put(b"ERR unknown command")
            return
        count = 0
        while count < _NUMBERS:
            at = _after(line, _after(line, at, length, False), length, True)  # the word after this one
            if at == length:
                break
            self.numbers[count] = number(line, at, length)
            count += 1
        if count < wanted:
            self.put(b"ERR %c needs %d values" % (letter, wanted))
            return
        self._act(letter, self.numbers)
        self.put(b"OK %c" % letter)


def _after(line: bytearray, at: int, end: int, blanks: bool) -> int:
    """Return where the row of blanks that starts at ``at`` ends; ``blanks`` False: the row of other bytes."""
    while at < end and (line[at] == _BLANK or 9 <= line[at] <= 13) == blanks:
        at += 1
    return at


def number(line: bytes | bytearray, at: int, end: int) -> float:
    """Return the decimal number at ``at``, without what follows it; 0 for anything else, also nan and inf."""
    negative = line[at] == 45  # "-"
    if negative or line[at] == 43:  # "+"
        at += 1
    digits = 0
    scale = 0  # 0: left of the point; else 10 ** digits right of it
    while at < end:
        byte = line[at]
        if byte == 46 and not scale:  # "."
            scale = 1
        elif not 48 <= byte <= 57:  # no digit
            break
        elif digits < _MANY and scale < _MANY:  # else skipped: the number is far too large, or exact enough
            digits = digits * 10 + byte - 48
            scale *= 10
        at += 1
    value = digits / (scale or 1)
    return -value if negative else value


def clamp(value: float, lowest: float) -> float:
    """Limit ``value`` to ``lowest`` .. 1."""
    return lowest if value < lowest else 1.0 if value > 1.0 else value
