"""The common part of boards that describe themselves to the host by pebble_serial_v1."""

import time

from micropython import const

from common.frames import Decoder, Sender

try:
    from common.usb import Port

    _CTRL_C = False
except ImportError:  # the official image of a XIAO SAMD21 lacks select and sys.stdin.buffer
    from common.uart import Port  # type: ignore[assignment]

    _CTRL_C = True

_AT_ONCE = const(64)  # bytes from the host per turn
_PIECE = const(32)  # to the host: a blocking write is harmless on these boards

_HELLO = const(0x01)
_DESCRIBE_REQ = const(0x02)
_DESCRIBE = const(0x03)
_CMD = const(0x20)
_ACK = const(0x21)
_NACK = const(0x22)
_LOG = const(0x30)
_PING = const(0x31)
_PONG = const(0x32)


class Described:
    """A board that answers the host. ``manifest`` is the payload of DESCRIBE; its frame fits ``ring`` bytes.

    The first ``hello`` bytes of the manifest are the payload of HELLO. Call ``receive`` at the beginning of each turn,
    ``port.send`` at its end. ``now`` wraps after 2**30 ms.
    """

    def __init__(self, manifest: bytes, hello: int, ring: int) -> None:
        self.now = time.ticks_ms()
        self.out = Sender(ring)
        self.out.used = 1  # a zero: it ends a frame that a reset has interrupted
        self.port = Port(self.out)
        self.port.chunk = _PIECE
        self.ctrl_c = _CTRL_C  # a DESCRIBE_REQ begins with 3, which is Ctrl-C: see common/run.py
        self.decoder = Decoder()
        self._manifest, self._hello = manifest, hello
        self._others = 0  # number of the newest frame of no interface, see `notify`; a gap shows that some were lost
        self._lost = 0  # frames for which there was no room
        self.asked = False  # for a DESCRIBE, which has not been sent yet
        self.notify(manifest[:hello], _HELLO)

    def receive(self) -> None:
        """Read and answer the host's frames."""
        self.now = time.ticks_ms()
        if not self.out.used:  # all was sent, so the host reads
            if self._lost:
                lost, self._lost = self._lost, 0
                self.notify(b"frames_lost=%d" % lost)
            elif self.asked:
                self.asked = False
                self.notify(self._manifest, _DESCRIBE)
        for _ in range(_AT_ONCE):
            byte = self.port.read()
            if byte < 0:
                break
            if self.decoder.take(byte):
                self._answer()

    def command(self) -> bytes:
        """Obey the command in ``decoder``; return why not, or empty bytes if it is obeyed."""
        return b"unknown_interface"

    def send(self, kind: int, interface: int, sequence: int, data: bytes | bytearray) -> bool:
        """Queue a frame; return False if there is no room for it."""
        sent = self.out.send(kind, interface, sequence, self.now, data)
        self._lost += not sent
        return sent

    def _answer(self) -> None:
        frame, kind = self.decoder, self.decoder.kind
        if kind == _DESCRIBE_REQ:
            self.notify(self._manifest[: self._hello], _HELLO)
            self.asked = True
        elif kind == _PING:
            self.send(_PONG, 0, frame.sequence, b"")
        elif kind == _CMD:
            why = self.command()
            self.send(_NACK if why else _ACK, frame.interface, frame.sequence, why)

    def notify(self, data: bytes, kind: int = _LOG) -> None:
        """Send a frame that belongs to no interface: a line for the host's log."""
        self._others += 1
        self.send(kind, 0, self._others, data)
