"""Plays a recording in order and at its pace. Pure: clocks, waiting and publishing are passed in."""

from collections.abc import Callable, Iterator
from typing import Final, Protocol

from pebble.extensions.recordings.files.reader import Chooses
from pebble.extensions.recordings.files.recorded import FOREVER_NS, Recorded
from pebble.extensions.recordings.replay.rules import Rules, zero
from pebble.transports import Message

SLOWEST, FASTEST = 0.1, 100.0  # speeds
_TICK_S: Final = 0.05  # at least so often the caller can act
_NOW_S: Final = 1e-6  # less is not worth waiting for
_RETRY_S: Final = 0.01  # after a message that was refused
_TRIES: Final = 50  # for the last zero
#: Later than this is made up by no burst of old messages: the recording goes on from where it is.
_LATE_S: Final = 0.5


class Source(Protocol):
    """The recording that a player plays."""

    def messages(self, since_ns: int, until_ns: int) -> Iterator[Recorded]:
        """Yield the messages of a period in the order of their arrival."""
        ...

    def state_before(self, at_ns: int, publishes: Chooses) -> list[Recorded]:
        """Return what a subscriber would know at a time, then the pictures without which the next cannot be decoded."""
        ...


class Output(Protocol):
    """The receiver of a player's messages."""

    sent: int
    skipped: int

    @property
    def moves(self) -> bool:
        """True if a sent message may have set something in motion."""
        ...

    def send(self, message: Recorded, position_ns: int) -> bool:
        """Send a message; return False if it cannot be sent now, so that the caller tries again."""
        ...

    def halt(self) -> None:
        """Stop what may be in motion."""
        ...


class BusOutput:
    """An output that publishes messages, and a zero after commands that moved something.

    ``publish`` returns False for a message that it cannot take now; ``wall_ns`` returns the time since 1970.
    """

    def __init__(self, rules: Rules, publish: Callable[[Message], bool], wall_ns: Callable[[], int]) -> None:
        self.sent = self.skipped = 0
        self._rules, self._publish, self._wall_ns = rules, publish, wall_ns
        self._moved: dict[str, None] = {}  # topics of drive commands without a zero after them, as an ordered set

    @property
    def moves(self) -> bool:
        """True if a published message may have set something in motion."""
        return bool(self._moved)

    def send(self, message: Recorded, position_ns: int) -> bool:
        """Publish a message; return True if it is done.

        Its stamps are moved so that it seems as old now as it was at ``position_ns``.
        """
        outgoing = self._rules.outgoing(message, self._wall_ns() - position_ns)
        if outgoing is None:
            self.skipped += 1
            return True
        if not self._publish(outgoing.message):
            return False
        self.sent += 1
        if outgoing.moves is not None:  # it is a drive command
            self._moved.pop(outgoing.message.topic, None)
            if outgoing.moves:
                self._moved[outgoing.message.topic] = None
        return True

    def halt(self) -> None:
        """Publish a zero for each drive command that may still move something.

        Without a connection the robot's own deadline has to stop it.
        """
        for topic in list(self._moved):
            if self._publish(zero(topic)):
                del self._moved[topic]


class Pace:
    """The position in a recording that is played at a speed, from a starting point on.

    Positions are in nanoseconds since 1970; ``now``, in seconds, never goes back.
    """

    def __init__(self, now: Callable[[], float], *, speed: float) -> None:
        self._now = now
        self.speed = min(max(speed, SLOWEST), FASTEST)
        self.from_ns, self._since_s = 0, 0.0  # a position, and when playing went on from it

    def change(self, speed: float, position_ns: int) -> None:
        """Play at another speed, from this position."""
        self.go_on_from(position_ns)
        self.speed = min(max(speed, SLOWEST), FASTEST)

    def go_on_from(self, position_ns: int) -> None:
        self.from_ns, self._since_s = position_ns, self._now()

    @property
    def reached_ns(self) -> int:
        """Return the present position, if nothing delays it."""
        return self.from_ns + int((self._now() - self._since_s) * self.speed * 1e9)

    def due_s(self, position_ns: int, now: float) -> float:
        """Return the seconds until a position is reached; negative if it is passed."""
        return (position_ns - self.from_ns) / 1e9 / self.speed + self._since_s - now


class Reading:
    """A position in a recording, at the next message to publish; ``skipped``: how many messages were left out."""

    def __init__(self, source: Source, publishes: Chooses, until_ns: int) -> None:
        self.next: Recorded | None = None
        self.state: list[Recorded] = []  # to be sent before the next message; in reverse, the last entry first
        self.skipped = 0
        self._source, self._publishes, self._until_ns = source, publishes, until_ns
        self._messages: Iterator[Recorded] = iter(())

    def open(self, since_ns: int) -> None:
        """Continue at another time, beginning with the state and the pictures that a decoder needs there."""
        self._messages = self._source.messages(since_ns, self._until_ns)
        self.state = self._source.state_before(since_ns, self._publishes)[::-1] if since_ns else []
        self.advance()

    def advance(self) -> None:
        """Find the next message to publish."""
        for message in self._messages:
            if self._publishes(message.channel):
                self.next = message
                return
            self.skipped += 1
        self.next = None


class Player:
    """A player that plays to the end. The function ``wait``, which it calls often, may pause, move and stop it."""

    def __init__(
        self,
        source: Source,
        publishes: Chooses,
        output: Output,
        *,
        now: Callable[[], float],
        wait: Callable[[float], None],
        since_ns: int = 0,
        until_ns: int = FOREVER_NS,
        speed: float = 1.0,
        loop: bool = False,
        paused: bool = False,
        stays: bool = False,
        longest_gap_ns: int = FOREVER_NS,
    ) -> None:
        """Prepare to play. ``wait`` waits up to so many seconds; ``now`` returns seconds and never goes back.

        ``stays``: pause at the end instead of returning, and accept any time as a position, also before the first
        message. A pause of the recording that is longer than ``longest_gap_ns`` is left out.
        """
        self.paused, self.ended = paused, False
        self.at_end = False  # it is paused there
        self._reading = Reading(source, publishes, until_ns)
        self._output = output
        self._pace = Pace(now, speed=speed)
        self._now, self._wait = now, wait
        self._since_ns, self._loop, self._stays, self._longest_gap_ns = since_ns, loop, stays, longest_gap_ns
        self._begins_ns = 0  # time of the first message; 0: there is none, or the player stays at the end
        self._waited_at = 0.0  # when ``wait`` returned last

    @property
    def sent(self) -> int:
        return self._output.sent

    @property
    def skipped(self) -> int:
        return self._reading.skipped + self._output.skipped

    @property
    def restores(self) -> bool:
        """True while the state for a new position is being sent."""
        return bool(self._reading.state)

    @property
    def position_ns(self) -> int:
        """Return the time in the recording, since 1970."""
        from_ns, next_ = self._pace.from_ns, self._reading.next
        if self.paused or self.ended:
            return from_ns
        reached_ns = self._pace.reached_ns
        return reached_ns if next_ is None else min(reached_ns, max(next_.log_ns, from_ns))

    @property
    def speed(self) -> float:
        return self._pace.speed

    @speed.setter
    def speed(self, speed: float) -> None:
        self._pace.change(speed, self.position_ns)

    def run(self) -> None:
        """Play to the end or until :meth:`stop`; then stop everything that moves, also after an error."""
        try:
            position_ns = self._since_ns if self._stays else 0  # 0: at the first message
            self._open(self._since_ns, position_ns)
            if self._reading.next is not None and not self._stays:
                self._begins_ns = self._reading.next.log_ns
            while not self.ended:
                self._step()
        finally:
            self._output.halt()
            if self._output.moves:  # a zero could not be published
                for _ in range(_TRIES):
                    self._wait(_RETRY_S)
                    self._output.halt()

    def pause(self) -> None:
        self._pace.from_ns = self.position_ns
        self.paused = True
        self._output.halt()

    def resume(self) -> None:
        if self.at_end:
            self.seek(self.position_ns)  # more may have been recorded meanwhile
        self.paused = False
        self._pace.go_on_from(self._pace.from_ns)

    def seek(self, to_ns: int) -> None:
        """Continue at another time, beginning with the state and the pictures that a decoder needs there."""
        self._output.halt()
        self._open(max(to_ns, self._begins_ns), to_ns)

    def stop(self) -> None:
        self._pace.from_ns = self.position_ns
        self.ended = True

    def _open(self, since_ns: int, position_ns: int = 0) -> None:
        """Read the messages from ``since_ns`` on, and play from ``position_ns``; 0: from the first message's time."""
        self.at_end = False
        self._reading.open(since_ns)
        if position_ns:
            position_ns = max(since_ns, position_ns)
        elif self._reading.next is not None:
            position_ns = self._reading.next.log_ns
        self._pace.go_on_from(position_ns)

    def _step(self) -> None:
        """Wait, send one message, or end: what is due now."""
        now, reading = self._now(), self._reading
        if now - self._waited_at > _TICK_S:  # also if messages are due all the time, ``wait`` may pause or stop this
            self._pass(0.0)
        elif reading.state:  # also while paused, so that a move is shown at once
            if self._send(reading.state[-1], self._pace.from_ns):  # the list is in reverse: its last entry is due first
                reading.state.pop()
        elif self.paused:
            self._output.halt()
            self._pass(_TICK_S)
        elif reading.next is None:
            self._end()
        else:
            self._play(reading.next, now)

    def _play(self, message: Recorded, now: float) -> None:
        """Send the next message if it is due, else wait for a moment."""
        due_s = self._pace.due_s(message.log_ns, now)
        if message.log_ns - self._pace.reached_ns > self._longest_gap_ns:
            self._pace.go_on_from(message.log_ns)  # leave out the rest of a long pause
        elif due_s > _NOW_S:
            self._pass(min(due_s, _TICK_S))
            return
        if due_s < -_LATE_S:  # too late to catch up: go on from here, too (a message after a long pause is never late)
            self._pace.go_on_from(message.log_ns)
        if self._send(message, message.log_ns):  # else it is tried again
            self._reading.advance()

    def _send(self, message: Recorded, position_ns: int) -> bool:
        """Send the message; return False if it has to be tried again."""
        done = self._output.send(message, position_ns)
        if not done:
            self._pass(_RETRY_S)
        return done

    def _pass(self, seconds: float) -> None:
        self._wait(seconds)
        self._waited_at = self._now()

    def _end(self) -> None:
        self._output.halt()
        if self._loop and self._begins_ns:
            self._pass(_TICK_S)  # else a recording of one message would be sent without a pause
            self._open(self._begins_ns)
        elif self._stays:
            self.pause()
            self.at_end = True
        else:
            self.stop()
