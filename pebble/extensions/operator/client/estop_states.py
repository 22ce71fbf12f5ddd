"""The reset of an emergency stop, for exactly the states that were read. Pure."""

from pebble.contract import ESTOP_RESET, codec
from pebble.contract.payloads import EstopReset
from pebble.extensions.operator.client.robot_estop import MAX_OWNERS as MAX_OWNERS
from pebble.extensions.operator.client.robot_estop import RobotEstop as RobotEstop
from pebble.motion.latch import stop_of
from pebble.transports import Message, QoS


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

    @property
    def free(self) -> bool:
        """True if every owner has confirmed that it is no longer stopped."""
        return all(self._is_free(owner) for owner in self.shown)

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
