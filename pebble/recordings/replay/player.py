"""Publishes a recording again, in its order and at its pace. Pure: clocks, waiting and publishing are passed in."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

from pebble.recordings.files.mcap import Recorded
from pebble.recordings.library import FOREVER_NS
from pebble.recordings.replay.rules import Rules, zero
from pebble.recordings.replay.source import ReplaySource
from pebble.transports import Message

SLOWEST, FASTEST = 0.1, 100.0
_TICK_S: Final = 0.05  # at least so often the caller can act
_NOW_S: Final = 1e-6  # less is not worth waiting for
_RETRY_S: Final = 0.01  # after a message that was refused
_TRIES: Final = 50  # for the last zero
#: Later than this is made up by no burst of old messages: the recording goes on from where it is.
_LATE_S: Final = 0.5


class Player:
    """Plays until the end; between its calls of ``wait`` it may be paused, moved and stopped."""

    def __init__(
        self,
        source: ReplaySource,
        rules: Rules,
        publish: Callable[[Message], bool],
        *,
        now: Callable[[], float],
        wall_ns: Callable[[], int],
        wait: Callable[[float], None],
        since_ns: int = 0,
        until_ns: int = FOREVER_NS,
        speed: float = 1.0,
        slowest: float = SLOWEST,
        loop: bool = False,
        paused: bool = False,
    ) -> None:
        """``publish`` returns False for what it cannot take now; ``wait`` waits for up to so many seconds.

        ``now`` never goes back, in seconds; ``wall_ns`` is the time since 1970.
        """
        self.sent = self.skipped = 0
        self.paused, self.ended = False, False
        self._source, self._rules, self._publish = source, rules, publish
        self._now, self._wall_ns, self._wait = now, wall_ns, wait
        self._since_ns, self._until_ns, self._loop = since_ns, until_ns, loop
        self._slowest, self._speed = slowest, min(max(speed, slowest), FASTEST)
        self._messages: Iterator[Recorded] = iter(())
        self._next: Recorded | None = None
        self._state: list[Recorded] = []  # to be sent before the next message
        self._moved: dict[str, None] = {}  # topics of drive commands without a zero after them
        self._begins_ns = self._from_ns = 0  # the first message; the position at _from
        self._from = self._waited = 0.0
        self._wants_pause = paused

    @property
    def position_ns(self) -> int:
        """The time in the recording, since 1970."""
        if self.paused or self.ended:
            return self._from_ns
        due_ns = self._from_ns + int((self._now() - self._from) * self._speed * 1e9)
        return due_ns if self._next is None else min(due_ns, max(self._next.log_ns, self._from_ns))

    @property
    def speed(self) -> float:
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        self._go_on_from(self.position_ns)
        self._speed = min(max(speed, self._slowest), FASTEST)

    def run(self) -> None:
        """Play to the end, or until :meth:`stop`; whatever moves is stopped then, also after an error."""
        try:
            self._open(self._since_ns)
            if self._next is not None:
                self._begins_ns = self._next.log_ns
            if self._wants_pause:
                self.pause()
            while not self.ended:
                self._step()
        finally:
            self._halt()
            for _ in range(_TRIES if self._moved else 0):
                self._wait(_RETRY_S)
                self._halt()

    def pause(self) -> None:
        self._from_ns = self.position_ns
        self.paused = True
        self._halt()

    def resume(self) -> None:
        self.paused = False
        self._go_on_from(self._from_ns)

    def seek(self, to_ns: int) -> None:
        """Go on from another time, with the state and the pictures that a decoder needs by then."""
        self._halt()
        self._open(max(to_ns, self._begins_ns), to_ns)

    def stop(self) -> None:
        self._from_ns = self.position_ns
        self.ended = True

    def _open(self, since_ns: int, position_ns: int = 0) -> None:
        self._messages = self._source.messages(since_ns, self._until_ns)
        self._state = self._source.state_before(since_ns, self._rules.publishes)[::-1] if since_ns else []
        self._advance()
        first_ns = position_ns if self._next is None else self._next.log_ns
        self._go_on_from(max(since_ns, position_ns) if position_ns else first_ns)

    def _advance(self) -> None:
        """Find the next message that is published; those between take no time."""
        for message in self._messages:
            if self._rules.publishes(message.channel):
                self._next = message
                return
            self.skipped += 1
        self._next = None

    def _go_on_from(self, position_ns: int) -> None:
        self._from_ns, self._from = position_ns, self._now()

    def _step(self) -> None:
        now = self._now()
        if self.paused:
            self._halt()
            self._pass(_TICK_S)
        elif now - self._waited > _TICK_S:
            self._pass(0.0)
        elif self._state:
            if self._send(self._state[-1], self._from_ns):
                self._state.pop()
        elif self._next is None:
            self._end()
        else:
            self._play(self._next, now)

    def _play(self, message: Recorded, now: float) -> None:
        due_s = (message.log_ns - self._from_ns) / 1e9 / self._speed + self._from - now
        if due_s > _NOW_S:
            self._pass(min(due_s, _TICK_S))
            return
        if due_s < -_LATE_S:
            self._go_on_from(message.log_ns)
        if self._send(message, message.log_ns):
            self._advance()

    def _pass(self, seconds: float) -> None:
        self._wait(seconds)
        self._waited = self._now()

    def _send(self, message: Recorded, position_ns: int) -> bool:
        """Whether it is done; a stamp was ``position_ns`` - stamp old then, and is as old now."""
        found = self._rules.outgoing(message, self._wall_ns() - position_ns)
        if found is None:
            self.skipped += 1
            return True
        if not self._publish(found.message):
            self._pass(_RETRY_S)
            return False
        self.sent += 1
        if found.moves is not None:
            self._moved.pop(found.message.topic, None)
            if found.moves:
                self._moved[found.message.topic] = None
        return True

    def _end(self) -> None:
        self._halt()
        if self._loop and self._begins_ns:
            self._pass(_TICK_S)  # a recording may be one message
            self._open(self._begins_ns)
        else:
            self.stop()

    def _halt(self) -> None:
        """A zero after each drive command that moves. Without a connection the robot's own deadline has to do."""
        self._moved = {topic: None for topic in self._moved if not self._publish(zero(topic))}
