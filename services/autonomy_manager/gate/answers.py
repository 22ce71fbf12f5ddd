"""Inserts the gate's answers into what the broker sends to a client, between two packets. Pure."""

from pebble.services.autonomy_manager.gate.packets import Kind, PacketError, packet_size

_MOST_WAITING = 64 * 1024  # bytes; each answer has four


class AnswerMerger:
    """Follows the packets from the broker without storing them; the first one, CONNACK, comes before all answers."""

    def __init__(self) -> None:
        self._head = bytearray()  # of the packet whose length is not known yet
        self._missing = 0  # bytes of the current packet
        self._begun = False  # a whole packet has passed
        self._waiting = bytearray()
        self.messages = 0  # from the broker, so far

    def answer(self, answers: bytes | bytearray) -> bytes:
        """What to send now, if the broker is between two packets; otherwise they wait for the end of its packet.

        Raises PacketError for a client that sends on and on while the broker does not finish a packet.
        """
        self._waiting += answers
        if len(self._waiting) > _MOST_WAITING:
            raise PacketError("too many packets wait for their acknowledgement")
        return self._take() if self._between else b""

    def feed(self, data: bytes) -> bytes:
        """``data`` of the broker with the waiting answers at the first boundary in it. Raises PacketError."""
        at = 0
        while at < len(data):
            at = self._advance(data, at)
            if self._waiting and self._between:
                return data[:at] + self._take() + self.feed(data[at:])
        return data

    @property
    def _between(self) -> bool:
        return self._begun and not self._missing and not self._head

    def _advance(self, data: bytes, at: int) -> int:
        """Go on to the end of the current packet, or of ``data``."""
        if self._missing:
            step = min(self._missing, len(data) - at)
            self._missing -= step
            at += step
        else:
            self._head.append(data[at])
            at += 1
            size = packet_size(self._head, limit=None)
            if size is not None:
                self._missing = size - len(self._head)
                self.messages += self._head[0] >> 4 == Kind.PUBLISH
                self._head.clear()
                self._begun = self._begun or not self._missing
                return at
        if not self._missing and not self._head:
            self._begun = True
        return at

    def _take(self) -> bytes:
        taken = bytes(self._waiting)
        self._waiting.clear()
        return taken
