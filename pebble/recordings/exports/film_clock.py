"""When a picture or a piece of sound belongs into a film, by its capture stamp."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from pebble.recordings.files.recorded import Recorded

_BACK_MS: Final = 1000  # a stamp so far behind the one before it is of a clock that was set
_AHEAD_MS: Final = 10_000  # or so far ahead of its reception, if it came as fast as the first one


@dataclass(slots=True)
class _Stream:
    offset_ms: int  # what is added to its stamps
    film_ms: int  # of its last message, before the origin is taken off
    log_ms: int


@dataclass(slots=True)
class FilmClock:
    """Turns capture stamps into times of the film, the same for all streams of a robot.

    The stamps count, not when a message was received, so a delay moves nothing. But a robot without a battery for its
    clock begins in 1970 and sets it once it is connected: such a step is taken out of all later stamps. Stamps of the
    streams pass it one after the other, so each has its own offset until its own stamps step.
    """

    steps: int = 0
    _origin_ms: int | None = None
    _offset_ms: int | None = None  # of the stream that stepped last
    _streams: dict[str, _Stream] = field(default_factory=dict)

    def of(self, stream: str, message: Recorded) -> Callable[[int | None], int]:
        """To be called with the capture stamp of ``message`` (ms since 1970; None: none); gives ms, at least 0."""
        log_ms = message.log_ns // 1_000_000
        return lambda captured_ms: self._place(stream, captured_ms, log_ms)

    def _place(self, name: str, captured_ms: int | None, log_ms: int) -> int:
        film_ms = log_ms if captured_ms is None else self._stamped(name, captured_ms, log_ms)
        if self._origin_ms is None:
            self._origin_ms = film_ms
        return max(0, film_ms - self._origin_ms)

    def _stamped(self, name: str, captured_ms: int, log_ms: int) -> int:
        if self._offset_ms is None:
            self._offset_ms = log_ms - captured_ms
        back_ms = _BACK_MS if name in self._streams else _AHEAD_MS  # other streams tell less of this one
        stream = self._streams.setdefault(name, _Stream(self._offset_ms, log_ms, log_ms))
        due_ms = stream.film_ms + log_ms - stream.log_ms
        stream.offset_ms = min(
            (stream.offset_ms, self._offset_ms), key=lambda offset_ms: abs(captured_ms + offset_ms - due_ms)
        )
        film_ms = captured_ms + stream.offset_ms
        if film_ms < stream.film_ms - back_ms or film_ms > log_ms + _AHEAD_MS:
            film_ms = due_ms
            self._offset_ms = stream.offset_ms = due_ms - captured_ms
            self.steps += 1
        stream.film_ms, stream.log_ms = film_ms, log_ms
        return film_ms
