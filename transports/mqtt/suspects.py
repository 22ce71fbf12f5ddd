"""Which topics a broker refuses by hanging up whenever one of them is published. Pure; times are one clock's seconds.

Many brokers answer a forbidden or too large PUBLISH by closing the connection, and MQTT 3.1.1 has no words for the
reason. Links lose connections as well. So a topic is withheld only after several losses in a row just after it was
written, and is given up only when its next message, alone and on a connection that has held without it, ends that too.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from enum import Enum
from math import inf
from typing import NamedTuple

from pebble.transports.base import Message
from pebble.transports.topics import matches

WINDOW_S = 1.0  # a broker that hangs up because of a message does it so soon after the message was written
HOLD_S = 10.0  # a connection without the suspects that holds this long is a good one
RETRY_S = 60.0  # between two attempts with a topic that is refused
QUIET_S = 2.0  # such an attempt waits until no message has arrived for so long: it may end the connection
PATIENCE_S = 600.0  # but no longer than this
TEST_S = 5.0  # after which a test that nothing has answered is over
VITAL_LOG_S = 60.0
SMALL = 256  # bytes that every broker takes: smaller messages count as so large
LARGE = 4096  # bytes from which the size of a message is the most likely reason
TOPICS = 1000  # at most are remembered
_FIRST, _MOST = 3, 48  # losses in a row that make a suspect; twice as many if the broker seemed to accept the topic


class Written(NamedTuple):
    """The newest messages of one topic at the loss of a connection."""

    size: int  # bytes of the largest
    answered: bool = False  # the answer to a later ping had come: brokers that decide slowly hang up after it


class Kind(Enum):
    SUSPECTED = "withheld for now"
    REFUSED = "withheld"
    VITAL = "never withheld"


class Assessment(NamedTuple):
    """What the loss of a connection has shown about topics, with the size of a message on each."""

    kind: Kind
    topics: Mapping[str, int]

    def text(self, where: str) -> str:
        topics, size = named(list(self.topics)), max(self.topics.values())
        if self.kind is Kind.SUSPECTED:
            large = f" of {size} bytes" if size >= LARGE else ""
            return (
                f"{where} closed several connections in a row just after a message{large} on {topics}: "
                f"nothing is sent there until a connection has held for {HOLD_S:.0f} s, then each is tried alone"
            )
        fix = f"allow this account to publish there{f', and messages of {size} bytes' if size > SMALL else ''}"
        if self.kind is Kind.VITAL:
            return (
                f"{where} closes the connection whenever a message on {topics} is published: "
                f"this account cannot run a robot, or drive one; {fix}"
            )
        return (
            f"a message of {size} bytes on {topics} is not sent: {where} closes the connection whenever it is; "
            f"{fix}. It is tried again each minute, and everything else goes on"
        )


@dataclass(slots=True)
class _Withheld:
    size: int  # bytes of the smallest message that may not be sent
    answered: bool  # the broker hangs up later than it answers a ping
    by_size: bool  # withheld only because of its size
    passes: int = -1  # bytes of the largest message that the broker has accepted since
    retry_at: float | None = None  # None: was not tried alone yet
    reported: bool = False


class _Test(NamedTuple):
    message: Message
    size: int
    since: float


class SuspectTopics:
    """Decides what one client may send to its broker. ``vital``: filters of topics that are never withheld."""

    def __init__(self, vital: Collection[str] = ()) -> None:
        self.withheld: dict[str, _Withheld] = {}
        #: Topics that may be at fault for the newest loss: a ping at once after the next message on each shows more.
        self.doubtful: set[str] = set()
        self._vital = tuple(vital)
        self._losses: dict[str, tuple[int, int]] = {}  # in a row, by topic: all, and those without an answer
        self._needed = _FIRST
        self._since = inf  # when the present connection began
        self._test: _Test | None = None
        self._vital_at = -inf

    def connected(self, now: float) -> None:
        self._since, self._test = now, None

    # -- sending

    def accepts(self, message: Message) -> bool:
        """Whether the broker accepts ``message``, as far as is known."""
        entry = self.withheld.get(message.topic)
        return entry is None or len(message.payload) <= entry.passes

    def tries(self, message: Message, now: float, arrived_at: float) -> bool:
        """Whether ``message``, which is not accepted, is sent all the same, to see what happens.

        ``arrived_at`` is when the newest message arrived.
        """
        entry, size = self.withheld[message.topic], max(SMALL, len(message.payload))
        if self._test is not None or not self._is_due(entry, size, now, arrived_at):
            return False
        self._test = _Test(message, size, now)
        return True

    def give_up(self) -> None:
        """The message to try was not sent."""
        self._test = None

    def due(self, now: float, arrived_at: float) -> list[str]:
        """Topics with which a message may be tried now."""
        if self._test is not None:
            return []
        return [topic for topic, entry in self.withheld.items() if self._is_due(entry, entry.size, now, arrived_at)]

    def _is_due(self, entry: _Withheld, size: int, now: float, arrived_at: float) -> bool:
        if size * 2 < entry.size:
            return True
        if now - self._since < HOLD_S:
            return False
        if entry.retry_at is None:
            return True
        return now >= entry.retry_at and (now - arrived_at >= QUIET_S or now - entry.retry_at >= PATIENCE_S)

    # -- what the connection shows

    def confirm(self, now: float, has_accepted: Callable[[str, int], bool]) -> tuple[Message, bool] | None:
        """The message that was tried and accepted, and whether its refusal was reported; None: nothing new.

        ``has_accepted`` is whether a message of a topic and size was, on this connection.
        """
        test = self._test
        if test is None:
            return None
        topic = test.message.topic
        entry = self.withheld.get(topic)
        if entry is None or not has_accepted(topic, test.size):
            if now - test.since > TEST_S:
                self._test = None
            return None
        if entry.answered and now - test.since < WINDOW_S:
            return None
        self._test = None
        if test.size < entry.size:
            entry.passes = test.size
            return test.message, False
        del self.withheld[topic]
        return test.message, entry.reported

    def lost(self, written: Mapping[str, Written] | None, now: float) -> Assessment | None:
        """The connection is lost. ``written`` by topic, shortly before; None: not closed because of any message."""
        held_s, self._since = now - self._since, inf
        test, self._test = self._test, None
        self.doubtful = set(written or ())
        if held_s >= HOLD_S:
            self._needed = _FIRST
        if test is not None and written is not None and test.message.topic in written:
            return self._refuse(test, now)
        if not written or (held_s < HOLD_S and self._suspects and all(one.answered for one in written.values())):
            self._acquit(held_s)
            return None
        counts = {topic: self._losses.get(topic, (0, 0)) for topic in written}
        self._losses = {
            topic: (all_ + 1, 0 if written[topic].answered else unanswered + 1)
            for topic, (all_, unanswered) in counts.items()
        }
        often = [topic for topic, (_, unanswered) in self._losses.items() if unanswered >= self._needed]
        often = often or [topic for topic, (all_, _) in self._losses.items() if all_ >= 2 * self._needed]
        return self._judge({topic: written[topic] for topic in often}, now) if often else None

    @property
    def _suspects(self) -> list[str]:
        return [topic for topic, entry in self.withheld.items() if entry.retry_at is None]

    def _acquit(self, held_s: float) -> None:
        """No message explains this loss. So the link is bad, if it comes soon after the suspects were withheld."""
        self._losses = {}
        if held_s < HOLD_S and (suspects := self._suspects):
            self._needed = min(2 * self._needed, _MOST)
            for topic in suspects:
                del self.withheld[topic]

    def _refuse(self, test: _Test, now: float) -> Assessment | None:
        topic, size = test.message.topic, test.size
        entry = self.withheld[topic]
        entry.size, entry.retry_at, entry.by_size = min(size, entry.size), now + RETRY_S, False
        is_new, entry.reported = not entry.reported, True
        return Assessment(Kind.REFUSED, {topic: len(test.message.payload)}) if is_new else None

    def _judge(self, often: Mapping[str, Written], now: float) -> Assessment | None:
        large = {topic: one for topic, one in often.items() if one.size >= LARGE and not one.answered}
        chosen = large or {topic: one for topic, one in often.items() if not self.is_vital(topic)}
        if not chosen:
            return self._report_vital({topic: one.size for topic, one in often.items() if not one.answered}, now)
        self._losses = {}
        if not large:  # it was not the size: these were withheld without a reason
            for topic in [topic for topic in self._suspects if self.withheld[topic].by_size]:
                del self.withheld[topic]
        for topic, one in chosen.items():
            self._withhold(topic, _Withheld(max(SMALL, one.size), one.answered, bool(large)))
        return Assessment(Kind.SUSPECTED, {topic: one.size for topic, one in chosen.items()})

    def _withhold(self, topic: str, entry: _Withheld) -> None:
        self.withheld.pop(topic, None)
        if len(self.withheld) >= TOPICS:
            del self.withheld[next(iter(self.withheld))]
        self.withheld[topic] = entry

    def is_vital(self, topic: str) -> bool:
        return any(matches(filter_, topic) for filter_ in self._vital)

    def _report_vital(self, topics: Mapping[str, int], now: float) -> Assessment | None:
        if not topics or now - self._vital_at < VITAL_LOG_S:
            return None
        self._vital_at = now
        return Assessment(Kind.VITAL, topics)


def is_large(written: Mapping[str, Written] | None) -> bool:
    """Whether the size of a message is the most likely reason for the loss of the connection."""
    return any(one.size >= LARGE for one in (written or {}).values())


def named(topics: list[str]) -> str:
    """Some of ``topics``, in words."""
    if len(topics) <= 3:
        return " and ".join([", ".join(topics[:-1]), topics[-1]] if len(topics) > 1 else topics)
    return f"{', '.join(topics[:2])} and {len(topics) - 2} more"
