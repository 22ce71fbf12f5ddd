"""A minute of a board on a serial line: lines at 50 Hz, lights, or requests for its manifest; noise, a long line,
silence."""

import board

_MINUTE_MS = 60_000
_LINE_MS = 20
_GARBAGE = b"x" * 600
_NOISE = bytes([index * 37 & 0xFF for index in range(300)])
# DESCRIBE_REQ with zeros, as in the protocol's description
_DESCRIBE = b"\x03\x01\x02\x01\x01\x01\x01\x01\x01\x01\x01\x01\x01\x03\x85\x6b\x00"


class Workload:
    def __init__(self, case):
        if case["stock"]:  # as the official image for the XIAO SAMD21 comes
            board.modules["select"] = board.Nothing
            del board.Stdin.buffer, board.Stdout.buffer
        self._described = case["described"]
        self._output = 0
        self._next = 0
        self._count = 0

    def between(self, robot):
        """What the host does before the board's next turn; returns what this part of the minute is called."""
        board.now += 10
        self._output += board.from_board.used
        board.from_board.clear()
        if board.now > _MINUTE_MS:
            return ""
        if board.now < self._next:
            return self._part
        self._next = board.now + _LINE_MS
        self._count += 1
        second = board.now // 1000
        if self._described:
            return self._describe(second)
        if second % 20 == 7:
            self._part = "a long line"
            board.to_board.put(_GARBAGE)
        elif second % 20 == 11:
            self._part = "noise"
            board.to_board.put(_NOISE[:120])
        elif second % 20 == 15:
            self._part = "silence"
        elif second % 20 == 17:
            self._part = "colours"
            board.to_board.put(b"\nL 0.100 0.200 0.300\nF 1.000 0.500 0.250 1.500\n")
        else:
            self._part = "driving"
            board.to_board.put(b"M 0.%03d -0.500\n" % (self._count % 1000))
        return self._part

    def _describe(self, second):
        self._part = "sampling"
        if self._count % 100 == 0:
            self._part = "describing"
            board.to_board.put(_DESCRIBE)
        elif second % 20 == 11:
            self._part = "noise"
            board.to_board.put(_NOISE)
        return self._part

    def check(self, robot):
        """Check that the board has sent enough."""
        assert self._output > (60 * 100 * 30 if self._described else 1000), "the board has sent hardly anything"
