"""The output to an open serial device: the bytes being written, then the lines that wait."""

from pebble.errors import DeviceError
from pebble.services.serial_mcu_bridge.line.outbox import Outbox
from pebble.services.serial_mcu_bridge.line.port import Port

_BITS_PER_BYTE = 10  # 8N1
_STALL_S = 1.0  # a device that accepts nothing for so long is closed and opened again


class Output:
    """An output that does not block. Its owner passes the port and the monotonic clock, and calls it under one lock.

    A line leaves the outbox only once it can be sent at once, because one in the kernel cannot be replaced.
    """

    def __init__(self, outbox: Outbox, stop: bytes, end: bytes, baud: int) -> None:
        self.outbox, self.stop = outbox, stop
        self.sending = b""  # lines, or the rest of one, not yet written to the kernel
        self.sent_until = 0.0  # the time when all bytes written have had time to be sent
        self._end, self._byte_s = end, _BITS_PER_BYTE / baud
        self._blocked_since: float | None = None

    def begin(self, port: Port) -> None:
        """Start on a newly opened device with a line end and the stop; forget earlier lines."""
        port.discard_output()  # an earlier process may have left old commands in the kernel
        self.outbox.clear()
        self.sending, self._blocked_since = self._end + self.stop, None

    def is_free(self, port: Port, now: float) -> bool:
        """True if the device has sent all bytes that were written to it."""
        return now >= self.sent_until and not port.queued()

    def write(self, port: Port, now: float, *, ready: bool) -> None:
        """Write until the kernel accepts no more; lines from the outbox are written only to a ``ready`` device."""
        while self.sending or (ready and self.outbox.waiting and self._next_line(port, now)):  # it sets `sending`
            sent = port.write(self.sending)
            if not sent:
                return
            self.sending = self.sending[sent:]
            self.sent_until = max(now, self.sent_until) + sent * self._byte_s
            self._blocked_since = None

    def check_stall(self, port: Port, now: float) -> None:
        """Raise DeviceError if the device has accepted nothing for too long; discard the bytes that it has not sent."""
        if self._blocked_since is None:
            self._blocked_since = now
        elif now - self._blocked_since > _STALL_S:
            port.discard_output()  # else a stuck device would execute old commands later
            raise DeviceError(f"{port.path} has accepted nothing for {_STALL_S} s")

    def replace_by_stop(self, port: Port) -> None:
        """Discard unsent bytes, and send the stop instead."""
        port.discard_output()
        port.write(self._end + self.stop)

    def _next_line(self, port: Port, now: float) -> bool:
        if not self.is_free(port, now):
            return False
        self.sending, self._blocked_since = self.outbox.take(now) or b"", None
        return bool(self.sending)
