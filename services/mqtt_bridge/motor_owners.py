"""Checks that messages pass between the robot's motor owners and this process."""

from collections.abc import Iterable

from pebble.contract import ESTOP_STATE
from pebble.runtime.parent import Notifier

CHECK_S = 1.0
_MISSED_S = 15.0  # owners publish their state every 5 s


class MotorOwners:
    """The motor owners whose states arrive here, for reports to the launcher; times are of the caller's clock.

    The first message of a connection does not count, because it may be a retained one.
    """

    def __init__(self, base: str, owners: Iterable[str], notifier: Notifier) -> None:
        self.topics = {ESTOP_STATE.topic(base, owner=owner): owner for owner in owners}
        self._notifier = notifier
        # By topic:
        self._messages = dict.fromkeys(self.topics, 0)  # how many arrived on this connection
        self._checked = dict(self._messages)  # the same number at the last check
        self._waits_since: dict[str, float | None] = dict.fromkeys(self.topics)  # for the next live message
        self._reported: dict[str, bool | None] = dict.fromkeys(self.topics)  # reached, as the launcher was told last

    def connected(self) -> None:
        """Note a new connection. Called on the transport's thread, like :meth:`receive`."""
        self._messages = dict.fromkeys(self.topics, 0)

    def receive(self, topic: str) -> None:
        self._messages[topic] += 1

    def check(self, now: float) -> None:
        """Report changes. Call this every ``CHECK_S``, on one thread."""
        for topic, owner in self.topics.items():
            count, count_before = self._messages[topic], self._checked[topic]
            self._checked[topic] = count
            waits_since, is_live = self._waits_since[topic], count > 1  # the first may be a retained one
            if waits_since is None or (is_live and count != count_before):  # wait for the next from now on
                waits_since = self._waits_since[topic] = now
            reached = now - waits_since < _MISSED_S
            if reached and not is_live:
                continue  # no live message yet, but one may still come in time: nothing to report
            if reached != self._reported[topic] and self._notifier.reaches(owner, reached):
                self._reported[topic] = reached
