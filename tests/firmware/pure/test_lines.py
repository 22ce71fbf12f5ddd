"""goob_base_v1 on the board's side."""

from common.lines import Lines, clamp, number


class Recorder:
    """Records the commands to the robot and the lines to the host."""

    def __init__(self):
        self.commands = []
        self.lines = Lines(self.act)

    def act(self, letter, numbers):
        self.commands.append((chr(letter), list(numbers)))

    def give(self, data):
        for byte in data:
            self.lines.take(byte)
        return self.received()

    def received(self):
        lines = self.lines
        size = len(lines.ring)
        output = bytes([lines.ring[(lines.first + index) % size] for index in range(lines.used)])
        lines.first = (lines.first + lines.used) % size
        lines.used = 0
        return output


def obeyed(data):
    calls = Recorder()
    answer = calls.give(data)
    return answer, [(letter, numbers[: {"M": 2, "L": 3, "F": 4}[letter]]) for letter, numbers in calls.commands]


M_ONE = [("M", [1.0, 1.0])]
#: What a line is answered, and what it does.
OBEYED = (
    (b"M 0.5 -0.25\n", b"OK M", [("M", [0.5, -0.25])]),
    (b"L 1 0.5 0\n", b"OK L", [("L", [1.0, 0.5, 0.0])]),
    (b"F 0.25 0.5 1 1.5\n", b"OK F", [("F", [0.25, 0.5, 1.0, 1.5])]),
    (b"M 1 1\r\n", b"OK M", M_ONE),
    (b" \tM\t 1   1  \r\n", b"OK M", M_ONE),
    (b"\n\r\n \n\t\n", b"", []),
    (b"M 1 1 spare tokens are ignored here\n", b"OK M", M_ONE),
    (b"M 1\n", b"ERR M needs 2 values", []),
    (b"m\n", b"ERR M needs 2 values", []),
    (b"L 1 1\n", b"ERR L needs 3 values", []),
    (b"F 1 1 1\n", b"ERR F needs 4 values", []),
    (b"X 1 1\n", b"ERR unknown command", []),
    (b"\xffM 1 1\n", b"ERR unknown command", []),
    (b"\x03M 1 1\n", b"ERR unknown command", []),
    (b"M 1 1 " + b"x" * 250 + b"\n", b"OK M", M_ONE),  # 256 bytes
    (b"M 1 1 " + b"x" * 251 + b"\n", b"WARN line too long", []),
)


def test_what_a_line_does():
    for line, answer, commands in OBEYED:
        assert obeyed(line) == (answer + b"\r\n" * bool(answer), commands), line


def test_an_unfinished_line_is_dropped_after_200_ms_of_silence():
    calls = Recorder()
    calls.give(b"M 0.9")
    calls.lines.rest(1000)
    calls.lines.rest(1199)
    assert calls.lines.length == 5
    calls.lines.rest(1200)
    assert calls.lines.length == 0
    assert calls.give(b"M 0 0\n") == b"OK M\r\n"
    assert calls.commands == [("M", [0.0, 0.0, 0.0, 0.0, 0.0])]


def test_a_line_too_long_is_discarded_and_reported_once():
    calls = Recorder()
    assert calls.give(b"M 1 1 " + b"x" * 1000) == b"WARN line too long\r\n"
    assert calls.give(b"M 1 1\nM 0.5 0.5\n") == b"OK M\r\n"
    assert calls.commands == [("M", [0.5, 0.5, 0.0, 0.0, 0.0])]


#: Texts and the numbers that they are; those of many digits nearly so.
NUMBERS = (
    (b"0.5", 0.5), (b"-.25", -0.25), (b"+1.", 1.0), (b"0.930", 0.93), (b"12.125", 12.125),
    (b"0." + b"3" * 200, 1 / 3), (b"0" * 200 + b"1", 1.0), (b"0." + b"0" * 200 + b"1", 0.0),
)  # fmt: skip


def test_numbers():
    for text, expected in NUMBERS:
        assert abs(number(text, 0, len(text)) - expected) < 1e-6, text
    for sign, limit in ((b"", 1.0), (b"-", -1.0)):
        text = sign + b"9" * 200
        assert clamp(number(text, 0, len(text)), -1.0) == limit


def test_clamp():
    assert clamp(2.0, -1.0) == 1.0
    assert clamp(-2.0, -1.0) == -1.0
    assert clamp(-2.0, 0.0) == 0.0
    assert clamp(0.25, 0.0) == 0.25


def test_a_host_that_does_not_read_loses_whole_lines():
    calls = Recorder()
    lines = calls.lines
    for _ in range(20):
        lines.put(b"T a0=512 a1=512 a2=512")
    assert calls.received() == b"T a0=512 a1=512 a2=512\r\n" * 5
    calls.give(b"M 1 1\n")
    assert calls.commands, "it is obeyed all the same"


def test_noise():
    calls = Recorder()
    value = 1
    known = 0
    for _ in range(5_000):
        for _ in range(8):
            value = (value * 1103515245 + 12345) & 0x3FFFFFFF
            calls.lines.take(value >> 16 & 0xFF)
        calls.lines.first = calls.lines.used = 0
        for letter, numbers in calls.commands:
            known += letter in "MLF"
            assert all(-1e9 <= one <= 1e9 for one in numbers)
        calls.commands = []
    assert calls.give(b"\nM 0.5 0.5\n")[-6:] == b"OK M\r\n"
    assert known < 5_000
