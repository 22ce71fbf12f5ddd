"""Goob's second board: describes its MPU-6050 to the host and sends its samples, by pebble_serial_v1."""

import struct
import time
from math import sqrt

from micropython import const

from common.frames import Decoder, Sender
from common.ticks import Grid
from goob_imu import pins
from goob_imu.imu import Imu
from goob_imu.manifest import MANIFEST
from goob_imu.mpu6050 import Mpu6050

try:
    from common.usb import Port

    _CTRL_C = False
except ImportError:  # the official image of a XIAO SAMD21 lacks select and sys.stdin.buffer
    from common.uart import Port  # type: ignore[assignment]

    _CTRL_C = True

_SAMPLE_MS = const(10)
_STATE_EVERY = const(20)  # samples: 5 Hz
_RING = const(512)  # bytes for the host; a DESCRIBE has 506
_AT_ONCE = const(64)  # bytes from the host per turn
_PIECE = const(32)  # to the host: a blocking write is harmless on this board
_G_MM_S2 = 9806.65

_IMU_FAST = const(1)  # interfaces, as in the manifest
_IMU = const(2)
_HELLO_SIZE = const(49)  # the manifest's beginning: the payload of HELLO

_HELLO = const(0x01)
_DESCRIBE_REQ = const(0x02)
_DESCRIBE = const(0x03)
_SAMPLE = const(0x10)
_STATE = const(0x11)
_CMD = const(0x20)
_NACK = const(0x22)
_LOG = const(0x30)
_PING = const(0x31)
_PONG = const(0x32)


class Robot:
    """The board, which has no motors. Call ``step`` at least every 10 ms."""

    def __init__(self) -> None:
        self.now = time.ticks_ms()  # which wraps after 2**30 ms
        self.out = Sender(_RING)
        self.out.used = 1  # a zero: it ends a frame that a reset has interrupted
        self.port = Port(self.out)
        self.port.chunk = _PIECE
        self.ctrl_c = _CTRL_C  # a DESCRIBE_REQ begins with 3, which is Ctrl-C: see common/run.py
        self.decoder = Decoder()
        self._others = 0  # number of the newest frame of no interface, see `notify`; a gap shows that some were lost
        self._lost = 0  # frames for which there was no room
        self.asked = False  # for a DESCRIBE, which has not been sent yet
        self.notify(MANIFEST[:_HELLO_SIZE], _HELLO)
        self.imu = Imu(Mpu6050(pins), self.notify)
        self._grid = Grid(_SAMPLE_MS, self.now)
        self._until_state = _STATE_EVERY
        self._payload = bytearray(18)
        self._samples = self._states = 0  # sequence numbers: a gap shows lost frames

    def step(self) -> None:
        self._receive()
        if self._grid.due(self.now):
            self._sample()
        self.port.send()

    def stop(self) -> None:
        """Do nothing: the board has no motors."""

    def notify(self, data: bytes, kind: int = _LOG) -> None:
        """Send a frame that belongs to no interface: a line for the host's log."""
        self._others += 1
        self._send(kind, 0, self._others, data)

    def _send(self, kind: int, interface: int, sequence: int, data: bytes | bytearray) -> None:
        """Queue a frame, or count it as lost if there is no room for it."""
        self._lost += not self.out.send(kind, interface, sequence, self.now, data)

    def _receive(self) -> None:
        """Read and answer the host's frames."""
        self.now = time.ticks_ms()
        if not self.out.used:  # all was sent, so the host reads
            if self._lost:
                lost, self._lost = self._lost, 0
                self.notify(b"frames_lost=%d" % lost)
            elif self.asked:
                self.asked = False
                self.notify(MANIFEST, _DESCRIBE)
        for _ in range(_AT_ONCE):
            byte = self.port.read()
            if byte < 0:
                break
            if self.decoder.take(byte):
                self._answer()

    def _answer(self) -> None:
        frame, kind = self.decoder, self.decoder.kind
        if kind == _DESCRIBE_REQ:
            self.notify(MANIFEST[:_HELLO_SIZE], _HELLO)
            self.asked = True
        elif kind == _PING:
            self._send(_PONG, 0, frame.sequence, b"")
        elif kind == _CMD:  # the board takes none
            self._send(_NACK, frame.interface, frame.sequence, b"unknown_interface")

    def _sample(self) -> None:
        imu = self.imu
        if imu.read(self.now):
            struct.pack_into("<9h", self._payload, 0, *imu.values)
            self._samples += 1
            self._send(_SAMPLE, _IMU_FAST, self._samples, self._payload)
        self._until_state -= 1
        if self._until_state:
            return
        self._until_state = _STATE_EVERY
        ax, ay, az = imu.values[:3]
        norm = int(sqrt(ax * ax + ay * ay + az * az) / _G_MM_S2 * 1000)
        struct.pack_into("<HhhhIIH", self._payload, 0, norm, *imu.bias, imu.good, imu.failed, imu.calibrated)
        self._states += 1
        self._send(_STATE, _IMU, self._states, self._payload)


def build(_settings: dict) -> Robot:
    return Robot()
