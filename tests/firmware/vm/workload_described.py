"""A minute of a board that describes itself: requests for its manifest, samples, noise."""

import board

_MINUTE_MS = 60_000
# DESCRIBE_REQ with zeros, as in the protocol's description; PING likewise
_DESCRIBE = b"\x03\x01\x02\x01\x01\x01\x01\x01\x01\x01\x01\x01\x01\x03\x85\x6b\x00"
_LEAST = 60 * 100 * 30  # bytes
_NOISE = bytes([index * 37 & 0xFF for index in range(300)])


class Workload:
    def __init__(self, case):
        if case["stock"]:
            board.modules["select"] = board.Nothing
            del board.Stdin.buffer, board.Stdout.buffer
        self._output = 0
        self._asked = 0

    def between(self, robot):
        board.now += 10
        self._output += board.from_board.used
        board.from_board.clear()
        if board.now > _MINUTE_MS:
            return ""
        second = board.now // 1000
        if board.now - self._asked >= 2000:
            self._asked = board.now
            board.to_board.put(_DESCRIBE)
            return "describing"
        if second % 20 == 11:
            board.to_board.put(_NOISE)
            return "noise"
        return "sampling"

    def check(self, robot):
        assert self._output > _LEAST, "the board has sent hardly anything"
