"""The emergency stop of a robot as its motor owners publish it, and the reset of exactly that. Pure."""

from __future__ import annotations

import re
from typing import Any

import msgspec

from pebble.contract import (
    AUTONOMY_COMMAND,
    CAPABILITIES,
    CONTROL_STATE,
    DRIVE,
    ESTOP_RESET,
    ESTOP_STATE,
    Channel,
    codec,
)
from pebble.contract.identity import LEVEL
from pebble.contract.payloads import EstopReset, EstopState
from pebble.errors import PayloadError, TransportError
from pebble.motion.latch import stop_of
from pebble.transports import Message, QoS, Transport
from pebble.transports.topics import check_topic

MAX_OWNERS = 16  # of one robot; a robot that lists more is never confirmed
_STATE_BYTES = 1024  # the contract allows 400
_CAPABILITIES_BYTES = 64 * 1024
_NAMES = 8  # in ``recent``
_LATEST_MS = 253_402_300_800_000  # the year 10000

_valid_level = re.compile(LEVEL).search


class RobotEstop:
    """The stop of one robot: the motor owners that it lists, and the newest state of each.

    ``by`` and ``why`` in the states are made short printable ASCII. The owners' names are not: make them printable
    before they reach a terminal.
    """

    def __init__(self, base: str) -> None:
        self.base = base
        self.has_capabilities = False
        self.announces = False  # its capabilities have a section about emergency stops
        self.available = False  # it can be stopped by an emergency stop
        self.keeps_control = False  # it decides itself which person drives it
        self.named = False  # it takes commands only with the name of their sender in the topic
        self.drives = True  # unless its capabilities say that it does not
        self.drive_topic = DRIVE.topic(base)
        self.script_topic = AUTONOMY_COMMAND.topic(base)
        self.zeros: tuple[str, ...] = ()  # drive topics of motors that no stop can hold: a stop sends zeros there
        self.owners: tuple[str, ...] = ()  # as its capabilities list them
        self._states: dict[str, EstopState] = {}
        self._capabilities_topic = CAPABILITIES.topic(base)
        self._prefix = ESTOP_STATE.topic(base).removesuffix("{owner}")

    @property
    def states(self) -> dict[str, EstopState]:
        """Return the stop states by motor owner; once capabilities are known, only of the listed owners."""
        if not self.has_capabilities:
            return dict(self._states)
        return {owner: self._states[owner] for owner in self.owners if owner in self._states}

    @property
    def latched(self) -> dict[str, EstopState]:
        """Return the states of the stopped owners."""
        return {owner: state for owner, state in self.states.items() if state.latched}

    @property
    def stopped_by(self) -> EstopState | None:
        """Return the newest stop among the stopped owners; None if the robot is not known to be stopped."""
        return max(self.latched.values(), key=lambda state: state.since, default=None)

    @property
    def lacks(self) -> bool:
        """True if the robot's capabilities are missing, or a state of an owner that they list."""
        return not self.has_capabilities or bool(self.missing)

    @property
    def missing(self) -> list[str]:
        """Return the topics of missing states of listed owners."""
        return [ESTOP_STATE.topic(self.base, owner=owner) for owner in self.owners if owner not in self._states]

    @property
    def missing_control(self) -> list[str]:
        """Return the topics of the control states that are missing, if the robot publishes control.

        An owner's control state counts as missing if its stop state is: a broker keeps back both states, or none.
        """
        owners = [owner for owner in self.owners if owner not in self._states] if self.keeps_control else []
        return [CONTROL_STATE.topic(self.base, owner=owner) for owner in owners]

    @property
    def old(self) -> bool:
        """True if the robot is known to have no emergency stop.

        False if a robot has one whose topics its broker refuses: its capabilities list the stop as not available.
        """
        return self.has_capabilities and not self.announces

    def subscribe(self, transport: Transport) -> None:
        """Subscribe on ``transport`` until it is closed; return when the retained messages have arrived."""

        def take(message: Message) -> None:
            self.receive(message)

        for channel in (ESTOP_STATE, CAPABILITIES):
            transport.subscribe(channel.filter(self.base), take, direct=True)
        transport.ask(self.missing)  # some brokers send retained messages only to subscriptions of exact names

    def receive(self, message: Message) -> bool:
        """Update from a message of this robot; return False if it is malformed, or not about the stop."""
        if message.topic == self._capabilities_topic:
            return self._receive_capabilities(message.payload)
        if message.topic.startswith(self._prefix):
            return self._receive_state(message.topic.removeprefix(self._prefix), message.payload)
        return False

    def _receive_capabilities(self, payload: bytes) -> bool:
        """Store what capabilities say about stops and commands; return False if they are malformed."""
        if len(payload) > _CAPABILITIES_BYTES:
            return False
        try:
            value = codec.decode(CAPABILITIES, payload).value
        except PayloadError:
            return False
        estop, drive = _section(value, "estop"), _section(value, "drive")
        self.announces, self.available = bool(estop), estop.get("available") is True
        self.owners = _owners(estop.get("owners"))
        self.keeps_control, self.named = drive.get("control") is True, value.get("named") is True
        self.drives = drive.get("available") is not False
        self.drive_topic = self._topic(drive.get("topic"), DRIVE)
        self.script_topic = self._topic(_section(value, "autonomy").get("command_topic"), AUTONOMY_COMMAND)
        listed = estop.get("zeros")
        topics = listed[:MAX_OWNERS] if isinstance(listed, list) else ()
        self.zeros = tuple(dict.fromkeys(self._topic(topic, DRIVE) for topic in topics))
        self.has_capabilities = True  # last: other threads may read meanwhile
        return True

    def _topic(self, listed: object, channel: Channel) -> str:
        """Return the topic that capabilities list for a channel; the channel's own if that is invalid or another's."""
        default = channel.topic(self.base)
        try:
            topic = check_topic(listed) if isinstance(listed, str) else default
        except TransportError:
            return default
        return default if is_of_another(topic, self.base) else topic

    def _receive_state(self, owner: str, payload: bytes) -> bool:
        """Store an owner's state, or remove it if it is empty; return False if there is none to store or remove."""
        if not _valid_level(owner) or len(payload) > _STATE_BYTES:
            return False
        if not payload:
            return self._states.pop(owner, None) is not None
        try:
            state = codec.decode(ESTOP_STATE, payload)
        except PayloadError:
            return False
        if not self.makes_room(self._states, owner):
            return False
        self._states[owner] = _clean(state)
        return True

    def makes_room(self, states: dict[str, Any], owner: str) -> bool:
        """Make room for a motor owner's state, by removing that of an unlisted owner; return False if none is."""
        if owner in states or len(states) < MAX_OWNERS:
            return True
        unlisted = next((other for other in states if other not in self.owners), None)
        if unlisted is None:
            return False
        del states[unlisted]
        return True


class Reset:
    """A reset of exactly the stops that a person was shown; it never ends a later stop."""

    def __init__(self, robot: RobotEstop, by: str) -> None:
        """Store the states to reset: those that ``robot`` has received until now."""
        self.robot = robot
        self.shown = robot.latched
        _, self._by, _ = stop_of({"by": by})  # as motor owners read it: short printable ASCII

    def messages(self) -> list[Message]:
        """Return the messages to publish, once: one for each stopped owner."""
        commands = [EstopReset(boot=state.boot, count=state.count, by=self._by) for state in self.shown.values()]
        topic, qos = ESTOP_RESET.topic(self.robot.base), QoS(ESTOP_RESET.default_qos)
        return [Message(topic, codec.encode(ESTOP_RESET, command), qos) for command in commands]

    @property
    def waiting(self) -> list[str]:
        """Return the owners that have not answered yet: their states still show the same stop."""
        return [owner for owner in self.shown if not self._has_answered(owner)]

    def refusals(self) -> dict[str, str]:
        """Return why owners are still stopped, in words. Call this when no answer is missing, or after a timeout."""
        return {owner: self._refusal(owner) for owner in self.shown if not self._is_free(owner)}

    def _has_answered(self, owner: str) -> bool:
        """True if the owner is free or was stopped again.

        A refusal in its state is no answer: it may be about the reset of another client.
        """
        before, now = self.shown[owner], self.robot.states.get(owner)
        return now is not None and (not now.latched or (now.boot, now.count) != (before.boot, before.count))

    def _is_free(self, owner: str) -> bool:
        state = self.robot.states.get(owner)
        return state is not None and not state.latched

    def _refusal(self, owner: str) -> str:
        """Return why an owner is still stopped."""
        before, now = self.shown[owner], self.robot.states.get(owner)
        if now is None:
            return "its state was removed"
        if now.boot != before.boot:
            return "it has restarted since"
        if now.count != before.count:
            return f"stopped again meanwhile by {now.by or 'unknown'}"
        if now.reset_refused == "old":
            return "the reset reached it too late"
        return "no answer (may this account reset it?)"


def _section(value: dict[str, Any], name: str) -> dict[str, Any]:
    section = value.get(name)
    return section if isinstance(section, dict) else {}


def _owners(listed: object) -> tuple[str, ...]:
    """Return the listed owners without repetitions. An invalid list gives none: such a robot is never confirmed."""
    if not isinstance(listed, list) or len(listed) > MAX_OWNERS:
        return ()
    if not all(isinstance(owner, str) and _valid_level(owner) for owner in listed):
        return ()
    return tuple(dict.fromkeys(listed))


def _clean(state: EstopState) -> EstopState:
    """Return the state with its texts made short and printable."""
    _, by, why = stop_of({"by": state.by, "why": state.why})
    since = state.since if 0 <= state.since < _LATEST_MS else 0
    return msgspec.structs.replace(state, by=by, why=why, since=since, recent=state.recent[:_NAMES])


def is_of_another(topic: str, base: str) -> bool:
    """True if ``topic`` belongs to another component. Topics of fewer than four levels belong to none.

    Capabilities may contain any topic, and their publisher may lack the right to publish there: a client that believed
    them would drive another robot.
    """
    levels = topic.split("/", 3)
    return len(levels) == 4 and "/".join(levels[:3]) != base
