"""A station of switched sockets: describes them to the host, switches their relays, and reports their state."""

from machine import Pin
from micropython import const

from common.described import Described
from common.ticks import Grid
from outlets import pins
from outlets.manifest import HELLO_SIZE, manifest

_CHECK_MS = const(20)
_RING = const(768)  # bytes for the host; a DESCRIBE of four outlets has 724

_HEADER_SIZE = const(13)
_STATE = const(0x11)
_BOUND = const(1)  # bits of a state
_REACHABLE = const(2)
_ON = const(4)
_UNSENT = const(255)  # instead of a state


class Robot(Described):
    """Its outlets are off after a reset and without a supply, and stay as they are while the host is silent."""

    def __init__(self, count: int) -> None:
        super().__init__(manifest(count), HELLO_SIZE, _RING)
        wired = pins.OUTLETS[:count]
        self._relays = [Pin(relay, Pin.OUT, value=0) for relay, _ in wired]
        self._supplies = [Pin(supply, Pin.IN, Pin.PULL_DOWN) for _, supply in wired]
        self._reported = bytearray(count)
        self._payload = bytearray(3)
        self._states = 0  # sequence number
        self._grid = Grid(_CHECK_MS, self.now)
        self._forget()

    def step(self) -> None:
        asked = self.asked
        self.receive()
        if asked and not self.asked:
            self._forget()  # a host that knows the manifest now needs all states
        if self._grid.due(self.now):
            self._report()
        self.port.send()

    def stop(self) -> None:
        for relay in self._relays:
            relay.value(0)

    def _forget(self) -> None:
        for index in range(len(self._reported)):
            self._reported[index] = _UNSENT

    def command(self) -> bytes:
        frame = self.decoder
        interface, data = frame.interface, bytes(frame.data[_HEADER_SIZE : frame.size])
        index = interface // 2
        if not interface & 1 or index >= len(self._relays):
            return b"unknown_interface"
        if data != b"\0" and data != b"\1":
            return b"bad_payload"
        if data[0] and not self._supplies[index].value():
            return b"command_failed"
        self._relays[index].value(data[0])
        return b""

    def _report(self) -> None:
        """Send the states that have changed; those for which there is no room are sent later, and are not lost."""
        for index in range(len(self._relays)):
            state = _BOUND
            if self._supplies[index].value():
                state |= _REACHABLE | (_ON if self._relays[index].value() else 0)
            else:
                self._relays[index].value(0)  # it must not come on by itself when the supply is back
            if state != self._reported[index]:
                for bit in range(3):
                    self._payload[bit] = state >> bit & 1
                if self.out.send(_STATE, 2 * index + 2, self._states + 1, self.now, self._payload):
                    self._states += 1
                    self._reported[index] = state


def build(settings: dict) -> Robot:
    return Robot(settings.get("outlets", len(pins.OUTLETS)))
