"""Control of a robot: its holder, as the motor owners publish it, and a client that requests it. Pure.

The robot keeps the state. A client repeats its request every second, more rarely over a thin link, and the published
state is the answer. If a robot has several motor owners, the first by name decides, so that two clients never share a
robot; a client that has control of another owner only releases it.
"""

import secrets
from collections.abc import Callable
from contextlib import suppress
from typing import Literal

import msgspec
from msgspec import UNSET, UnsetType

from pebble.contract import CONTROL, CONTROL_STATE, CONTROL_TAKE, codec
from pebble.contract.channels import Channel
from pebble.contract.payloads import ControlRequest, ControlState
from pebble.errors import PayloadError
from pebble.extensions.operator.client.pace_of_link import WIDE, Pace, ms
from pebble.extensions.operator.client.robot_estop import RobotEstop
from pebble.motion import lease
from pebble.transports import Message, QoS

UNANSWERED = "does not answer"
ASKS_S = 30.0  # so long a driver is asked
APART = 1.5  # periods of requests that a client waits for its turn, so that another gets all motor owners meanwhile
IDLE_S = 60.0  # without a gesture control is given back

_STATE_BYTES = 1024  # the contract allows 300
_ID = 8  # characters of an id, and of a key
_KEYS = 8  # at most in one command: motor owners read no more
_NAME, _DEVICE = 40, 20  # characters, as robots cut them


class RobotControl:
    """The control of one robot, from the states of its motor owners. ``estop`` knows which owners are listed."""

    def __init__(self, estop: RobotEstop) -> None:
        self.base = estop.base
        self._estop = estop
        self._states: dict[str, ControlState] = {}
        self._prefix = CONTROL_STATE.topic(estop.base).removesuffix("{owner}")

    @property
    def states(self) -> list[ControlState]:
        """Return the owners' states, ordered by name; once capabilities are known, only of the listed owners."""
        names = self._estop.owners if self._estop.has_capabilities else self._states
        return [self._states[name] for name in sorted(names) if name in self._states]

    @property
    def state(self) -> ControlState | None:
        """Return the deciding owner's state; None if none is known."""
        return next(iter(self.states), None)

    @property
    def who(self) -> str:
        """Return the name of the holder of control, for people; "" if there is none."""
        state = self.state
        return "" if state is None or not state.id else state.by or "somebody"

    def receive(self, message: Message) -> bool:
        """Update from a message of this robot; return True if a state of control was stored or removed."""
        owner = message.topic.removeprefix(self._prefix)
        if owner == message.topic or len(message.payload) > _STATE_BYTES:
            return False
        if not message.payload:
            return self._states.pop(owner, None) is not None
        if not self._estop.makes_room(self._states, owner):
            return False
        with suppress(PayloadError):
            state: ControlState = codec.decode(CONTROL_STATE, message.payload)
            if max(map(len, (state.id, state.key, state.asks_id))) <= _ID:
                self._states[owner] = _clean(state)
                return True
        return False


class ControlClient:
    """A tab or process that requests control. Call :meth:`update` after each state, and :meth:`tick` often.

    ``held``: the robot has confirmed that this client has control. ``failed``: why it has given up, for people.
    """

    def __init__(
        self, robot: RobotControl, *, by: str, device: str, pace_of: Callable[[], Pace] = lambda: WIDE
    ) -> None:
        self.robot = robot
        self.id = secrets.token_hex(4)
        self.wanted = self.held = False
        self.decided = ""  # the deciding owner's key while control is held: with another key a new gesture is needed
        self.failed = ""
        self._by, self._device, self._pace_of = by, device, pace_of
        self._take = False  # the next request takes control from its holder
        # When this client began to ask, when the robot last showed that it deals with requests, when the next is due.
        self._asked_at = self._answered_at = self._due_at = 0.0
        self._out: list[Message] = []

    # -- what is wanted

    def ask(self, now: float, *, over: bool = False) -> None:
        """Start requesting control: ask its holder or, with ``over``, take it."""
        if not self.wanted:
            self.failed, self._out = "", []  # a release that was not sent yet is void
        self.wanted, self._take = True, over
        self._asked_at = self._answered_at = self._due_at = now
        self.update(now)

    def release(self) -> None:
        """Release control, or stop asking, with the next :meth:`tick`."""
        if self.wanted:
            self._out.append(self._message(CONTROL, want="release"))
        self.wanted = self.held = False
        self.decided = ""

    # -- what follows

    def update(self, now: float) -> None:
        """Update from the robot's states."""
        state = self.robot.state
        if not self.wanted or state is None:
            return
        if state.id == self.id:
            self.held, self.decided, self._take = True, state.key, False
            return
        if self.held and state.id:  # it was taken over, or ended while this client was not heard
            self._give_up(f"{self.robot.who} has control now")
            return
        if self.held:  # free: control has ended, or the motor owner was started again: request it anew, at once
            self._asked_at = self._answered_at = self._due_at = now
        self.held, self.decided = False, ""
        if state.asks_id:  # the robot deals with requests: it asks the holder for this client, or for an earlier one
            self._answered_at = now
        has_another_owner = any(owner.id == self.id for owner in self.robot.states)
        if state.id and has_another_owner:  # another client has the deciding owner: first let it get all of them
            self._out = [self._message(CONTROL, want="release")]
            self._due_at = max(self._due_at, now + APART * self._pace_of().control_s)

    def tick(self, now: float) -> list[Message]:
        """Return the messages to publish now."""
        self.update(now)
        if self.wanted and not self.held and (why := self._hopeless(now)):
            self._give_up(why)
        if self.wanted and now >= self._due_at:
            pace = self._pace_of()
            self._due_at = now + pace.control_s
            channel = CONTROL_TAKE if self._take else CONTROL
            sent_ms = ms(now) if pace.stamped else UNSET
            self._out.append(self._message(channel, for_ms=pace.control_for_ms, t=sent_ms))
            self._take = False
        out, self._out = self._out, []
        return out

    @property
    def done(self) -> bool:
        """True if this client no longer wants control, and has nothing left to publish."""
        return not self.wanted and not self._out

    @property
    def key(self) -> str:
        """Return the keys for a drive command, one of each motor owner that has given control to this client."""
        keys = [state.key for state in self.robot.states if state.id == self.id]
        return " ".join(keys[:_KEYS]) if self.held else ""

    @property
    def asked_by(self) -> str:
        """Return the name of a client that asks this one for control; "" if none does."""
        state = self.robot.state
        if not self.held or state is None or state.asks_id in ("", self.id):
            return ""
        return state.asks or "somebody"

    def _give_up(self, why: str) -> None:
        self.release()
        self.failed = why

    def _hopeless(self, now: float) -> str:
        """Return why to give up the request; empty to continue."""
        if now - self._answered_at > self._pace_of().answer_s:
            return f"{self.robot.base.rpartition('/')[2]} {UNANSWERED}"
        if now - self._asked_at > ASKS_S:
            return f"{self.robot.who} drives on"
        return ""

    def _message(
        self,
        channel: Channel,
        want: Literal["hold", "release"] = "hold",
        for_ms: float = WIDE.control_for_ms,
        t: int | UnsetType = UNSET,
    ) -> Message:
        """Return a request on CONTROL or CONTROL_TAKE; ``t``: the time stamp, where the link's pace wants one."""
        request = ControlRequest(id=self.id, want=want, for_ms=for_ms, by=self._by, device=self._device, t=t)
        return Message(channel.topic(self.robot.base), codec.encode(channel, request), QoS(channel.default_qos))


def _clean(state: ControlState) -> ControlState:
    """Return the state with its names made short and printable."""
    by, asks = (lease.shown(text, _NAME) for text in (state.by, state.asks))
    return msgspec.structs.replace(state, by=by, asks=asks, device=lease.shown(state.device, _DEVICE))
