"""A board's hardware for the interpreter in Node.js, written so that it costs the robot under test next to nothing.

Whatever a real board keeps outside MicroPython's heap (network buffers, what came over USB) lies in buffers made
here, before anything is measured. Time is virtual: `now` is milliseconds.
"""

import gc as _gc
import os as _os
import sys

modules = sys.modules
now = 0


class Time:
    @staticmethod
    def ticks_ms():
        return now


class Ring:
    """Bytes under way, outside the heap of a real board."""

    def __init__(self, size):
        self._bytes = bytearray(size)
        self._view = memoryview(self._bytes)
        self.clear()

    def clear(self):
        self._first = self.used = 0

    def put(self, data):
        if self.used + len(data) > len(self._bytes):
            return False
        if self._first + self.used + len(data) > len(self._bytes):
            self._view[: self.used] = self._view[self._first : self._first + self.used]
            self._first = 0
        start = self._first + self.used
        self._view[start : start + len(data)] = data
        self.used += len(data)
        return True

    def readinto(self, buffer):
        """None when there is nothing: it would block."""
        count = min(len(buffer), self.used)
        if not count:
            return None
        for index in range(count):
            buffer[index] = self._bytes[self._first + index]
        self._first += count
        self.used -= count
        return count

    def take(self, data, first, count):
        """A stream's write(data), write(data, count) or write(data, first, count), byte by byte: no garbage.

        None when there is no room at all: it would block (py/stream.c).
        """
        if count is None:
            first, count = 0, len(data) if first is None else first
        size = len(self._bytes)
        if self.used == 0:
            self._first = 0
        count = min(count, size - self._first - self.used)
        start = self._first + self.used
        for index in range(count):
            self._bytes[start + index] = data[first + index]
        self.used += count
        return count or None

    def all(self):
        data = bytes(self._view[self._first : self._first + self.used])
        self.clear()
        return data


to_board, from_board = Ring(8192), Ring(16384)


class Stdin:
    def readinto(self, buffer):
        return to_board.readinto(buffer)

    def any(self):
        return to_board.used


class Stdout:
    def write(self, data, first=None, count=None):
        return from_board.take(data, first, count) or 0


class Uart(Stdin, Stdout):
    def __init__(self, *_, **__):
        pass


class Sys:
    stdin, stdout = Stdin(), Stdout()


Stdin.buffer, Stdout.buffer = Sys.stdin, Sys.stdout


class Part:
    """A pin, a PWM or ADC channel, a timer, or the watchdog."""

    IN, OUT, PULL_UP, PULL_DOWN = 0, 1, 1, 2
    ONE_SHOT, PERIODIC = 0, 1
    ATTN_11DB = 3

    def __init__(self, *_, **__):
        pass

    def value(self, *_, **__):
        return 0

    __call__ = on = off = freq = deinit = init = feed = value

    def duty_u16(self, duty=0):
        assert 0 <= duty <= 65535
        return duty

    def read_u16(self):
        return now * 37 & 0xFFFF


class I2C:
    """The bus has an MPU-6050 on it that lies still, and a motor shield that takes everything."""

    def __init__(self, *_, **__):
        pass

    def writeto(self, address, data):
        return len(data)

    def writeto_mem(self, address, register, data):
        pass

    def readfrom_mem(self, address, register, count):
        return b"\x68" * count

    def readfrom_mem_into(self, address, register, buffer):
        for index in range(len(buffer)):
            buffer[index] = 0
        buffer[4] = 0x20  # 1 g upwards


class Machine:
    Pin = PWM = ADC = WDT = Timer = Part
    UART = Uart
    I2C = SoftI2C = I2C

    @staticmethod
    def reset():
        raise SystemExit("machine.reset()")


class Poll:
    """The poll of one stream; as in C, asking makes no garbage but the answer."""

    def register(self, stream, mask):
        self._stream = stream
        self._answer = ((stream, mask),)
        self._mask = mask

    def ready(self):
        if self._stream is Sys.stdin:
            return to_board.used > 0
        if self._stream is Sys.stdout:
            return True
        return self._stream.ready(self._mask)

    def ipoll(self, timeout=-1):
        return self._answer if self.ready() else ()

    def poll(self, timeout=-1):
        return [self._answer[0]] if self.ready() else []


class Select:
    POLLIN, POLLOUT = 1, 4
    poll = Poll


class Errno:
    EINPROGRESS, EAGAIN = 115, 11


class Os:
    @staticmethod
    def urandom(count):
        return bytes([index * 73 + now & 0xFF for index in range(count)])

    listdir, rename = staticmethod(_os.listdir), staticmethod(_os.rename)


class Gc:
    """Garbage is only collected between two turns, so this notes how much there is: ``most`` since ``start``."""

    start = most = 0

    @staticmethod
    def collect():
        Gc.most = max(Gc.most, _gc.mem_alloc() - Gc.start)
        Gc.start = _gc.mem_alloc()


class Nothing:
    """A module that this board does not have: `from select import poll` is an ImportError."""


modules["time"] = Time
modules["machine"] = Machine
modules["select"] = Select
modules["errno"] = Errno
modules["os"] = Os
modules["gc"] = Gc
modules["sys"] = Sys
