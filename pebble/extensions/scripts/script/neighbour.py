"""Another robot of the LAN, as a script of this robot uses it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, NamedTuple

from pebble.contract import DRIVE, NEIGHBOURS, TO_NEIGHBOUR, Channel, codec
from pebble.contract.identity import Identity
from pebble.contract.payloads import SCRIPT, Drive, Neighbours
from pebble.errors import PebbleError
from pebble.extensions.scripts.script.wheels import Wheels
from pebble.transports import QoS, Transport

PRESENT_S = 1.0  # so long a robot is there after it was received last; it comes four times a second
_SLOT_S = 0.019  # between commands: at most 50 in a second


class NotGrantedError(PebbleError):
    """An error: the other robot's config does not permit this robot to do that."""


class RobotParts(NamedTuple):
    """The parts of the script's own robot that a neighbour needs."""

    transport: Transport
    wheels: Wheels
    latest_there: Callable[[Channel, float], Any]  # returns the neighbour's newest payload, if it is young enough
    check: Callable[[], None]  # raises once the script must end
    check_drives: Callable[[], None]  # also raises if the script may not drive
    clock: Callable[[], float]


class Neighbour:
    """The robot ``name`` as ``me`` sees it; :meth:`pebble.script.Robot.neighbour` makes it. Any thread may use it."""

    def __init__(self, name: str, me: Identity, own: RobotParts) -> None:
        self.name = name
        self._me, self._own = me.id, own
        self._topic = TO_NEIGHBOUR.topic(me.base, robot=name)
        self._sent_at = float("-inf")
        self._moves = False  # the newest command moves it
        self._over = False  # the script has ended
        self._lock = threading.Lock()  # else the last command might come after the final zero
        own.latest_there(NEIGHBOURS, PRESENT_S)  # the first call subscribes; nothing has arrived yet

    @property
    def online(self) -> bool:
        """True if the neighbour was heard within the last second."""
        return self._state is not None

    def latest(self, channel: Channel, max_age: float = 1.0) -> Any:
        """Return the newest payload of ``channel`` that arrived within the last ``max_age`` seconds, or None.

        Does not wait. The first call subscribes, and mostly returns None. The other robot's config has to list it in
        ``shares``, and this one's in ``listens``.
        """
        self._own.check()
        return self._own.latest_there(channel, max_age)

    def drive(self, x: float = 0.0, z: float = 0.0, y: float = 0.0) -> bool:
        """Drive the other robot, for 0.3 s at most, like :meth:`Robot.drive`.

        False: the command has no effect, as far as is known. Raises NotGrantedError if the other robot's config does
        not permit this robot to drive it.
        """
        self._own.check_drives()
        command = Drive(x=float(x), z=float(z), y=float(y), source=SCRIPT, run=self._own.wheels.run)
        state, now = self._state, self._own.clock()
        if state is not None and DRIVE.metric not in state.commanded.get(self._me, ()):
            raise NotGrantedError(
                f"{self.name} does not let {self._me} drive it: its config needs "
                f'services.neighbours.commanded: {{"{self._me}": ["{DRIVE.metric}"]}}'
            )
        own_refusal = self._own.wheels.drive_another()  # what refuses this run here, refuses it there
        refusal = own_refusal or self.why_refused
        if command.moves and refusal:
            return False
        # a change between moving and standing is sent at once, all else at most 50 times a second
        if command.moves is self._moves and now - self._sent_at < _SLOT_S:
            return not refusal
        self._sent_at = now
        return self._send(command) and not refusal

    def stop(self) -> bool:
        """Stop the other robot's wheels: the same as ``drive()``."""
        return self.drive()

    @property
    def why_refused(self) -> str:
        """Reason why :meth:`drive` would have no effect now; empty if it would have one, as far as is known."""
        state = self._state
        if state is None:
            return f"{self.name} is not heard"
        refusal = state.refused.get(self._me)
        return refusal.why if refusal is not None and refusal.run == self._own.wheels.run else ""

    def end(self) -> None:
        """Stop the motion that this script causes there."""
        self._over = True
        if self._moves:
            self._send(Drive(source=SCRIPT, run=self._own.wheels.run))

    @property
    def _state(self) -> Neighbours | None:
        state: Neighbours | None = self._own.latest_there(NEIGHBOURS, PRESENT_S)
        return state

    def _send(self, command: Drive) -> bool:
        raw = codec.encode(TO_NEIGHBOUR, command)
        with self._lock:
            if command.moves and self._over:
                return False
            self._moves = command.moves
            return self._own.transport.publish(self._topic, raw, qos=QoS.DELIVERED, urgent=True)
