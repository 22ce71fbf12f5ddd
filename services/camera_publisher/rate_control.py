"""Reduces pictures on a slow connection: first their quality, then their size, then their number.

It compares the time for which each frame kept the connection busy with the time between two frames. It never sends more
than is configured in order to measure. Pure: times are passed in.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

from pebble.extensions.media.rests import Rests
from pebble.services.camera_publisher.frame_selector import FrameSelector
from pebble.services.camera_publisher.send_window import Acknowledged, SendWindow
from pebble.transports.base import Outgoing
from pebble.transports.counters import Counters

_FULL = 0.85  # share of the time the connection may be busy before something is reduced
_AIM = 0.6  # share it should be busy afterwards, and may be once something is restored
_LOST = 0.05  # frames lost for each that was sent; more means that the connection is full, however short its times
_STUCK_S = 0.5  # a frame that takes longer is answered at once
_WINDOW_S = 3.0  # of the frames that count; long enough for a full picture among the differences
_MEASURE_S = 1.0  # after a change, before an average means anything
_PATIENCE_S, _LONGEST_PATIENCE_S = 4.0, 60.0  # of good times before something is restored
_PROBATION_S = 10.0  # something that was restored too early shows by then
#: Bytes beside payload and topic that a message takes on the wire: MQTT's header, and TLS's for each record of 16 KiB.
#: Too many do no harm: what is in flight seems to have arrived by that much earlier.
_HEADER, _PER_RECORD, _RECORD = 8, 30, 16 << 10


def wire_size(topic: str, payload: bytes) -> int:
    """Return roughly how many bytes a message takes on the wire."""
    size = _HEADER + len(topic) + len(payload)
    return size + _PER_RECORD * (1 + size // _RECORD)


class RateController:
    """A controller of the frames that are sent, and of their encoding (``step``). No picture waits behind another.

    ``outgoing()`` returns the unacknowledged messages of the connection. A frame that was due and not encoded because
    of them is counted as ``held_back``. ``thin``: the connection may carry very little, so pictures begin small, and a
    slow one is followed by a pause.
    """

    def __init__(
        self, fps: float, now: float, outgoing: Callable[[], Outgoing], counters: Counters, *, thin: bool = False
    ) -> None:
        self._fps, self._outgoing, self._counters = fps, outgoing, counters
        self._selector, self._window, self._rests = FrameSelector(fps), SendWindow(), Rests(thin)
        self._levels = LevelControl(fps, now, SMALL if thin else 0)
        self._blocked = False  # since the last encoded frame another was held back, because of a late one in flight
        self._changed = False  # ``step`` has changed since the last poll

    @property
    def step(self) -> Step:
        """Way to encode the next frame."""
        return self._levels.step

    @property
    def in_flight(self) -> bool:
        """True if a picture is in flight: then call :meth:`poll` every 20 ms, to measure its time."""
        return len(self._window) > 0

    def may_encode(self, captured_s: float, now: float) -> bool:
        """True if a frame captured at ``captured_s`` may be encoded now. The frame has then used its turn."""
        if not self._selector.due(captured_s):
            return False
        round_trip_s = self._update(now)
        if self._rests.lasts(now):
            self._counters.add("held_back")
            return False
        if self._window.full(round_trip_s, now):
            self._blocked = self._blocked or self._window.age_s(round_trip_s, now) > 0
            self._counters.add("held_back")
            return False
        missed = self._selector.use(captured_s)
        if self._blocked:  # else turns were missed because the camera was late
            self._levels.lost(missed, now)
        self._blocked = False
        return True

    def sent(self, size: int, now: float) -> None:
        """Note that the connection has accepted a picture of ``size`` bytes on the wire."""
        self._window.sent(size, now)

    def poll(self, now: float) -> Step | None:
        """Measure what was acknowledged; return the step if it has changed since the last poll, else None."""
        self._update(now)
        changed, self._changed = self._changed, False
        return self.step if changed else None

    def connection_lost(self) -> None:
        self._window.clear()

    def _update(self, now: float) -> float:
        """Note what was acknowledged, and adapt to it; return the connection's round trip in seconds."""
        outgoing = self._outgoing()
        acknowledged = self._window.poll(outgoing.waiting, outgoing.round_trip_s, now)
        for frame in acknowledged:
            self._rests.note(frame.took_s, now)
        if self._levels.poll(acknowledged, self._window.age_s(outgoing.round_trip_s, now), now):
            self._selector.fps = self._fps * float(self.step.rate)
            self._changed = True
        return outgoing.round_trip_s


@dataclass(frozen=True, slots=True)
class Step:
    """A way to send pictures, as shares of the configured quality, size and rate."""

    quality: Fraction
    size: Fraction  # of width and of height
    rate: Fraction
    bytes: float  # of one picture, roughly

    @property
    def cost(self) -> float:
        """Share of the full bytes per second. Fewer frames save a little less: each differs more from the last."""
        return self.bytes * math.pow(self.rate, 0.9)

    def __str__(self) -> str:
        """Return the reduced properties for display: "quality 1/2, size 3/4"; empty if there are none."""
        parts = {"quality": self.quality, "size": self.size, "rate": self.rate}
        return ", ".join(f"{name} {share}" for name, share in parts.items() if share != 1)


def _step(quality: str, size: str, rate: str) -> Step:
    """Return a step. A JPEG has two thirds of the bytes at half the quality, a third at half the width and height."""
    q, s, r = Fraction(quality), Fraction(size), Fraction(rate)
    return Step(q, s, r, math.pow(q, 0.6) * math.pow(s, 1.6))


#: From everything to the least that still shows something.
STEPS = (
    _step("1", "1", "1"),
    _step("3/4", "1", "1"),
    _step("1/2", "1", "1"),
    _step("1/2", "3/4", "1"),
    _step("1/2", "1/2", "1"),
    _step("1/2", "3/8", "1"),
    _step("1/2", "1/4", "1"),
    _step("1/2", "1/4", "2/3"),
    _step("1/2", "1/4", "1/2"),
    _step("1/2", "1/4", "1/4"),
    _step("1/2", "1/4", "1/8"),
)
SMALL = 6  # of them: small pictures, as many as are configured


class LevelControl:
    """The choice among STEPS: down at once as far as necessary, up one step at a time.

    After each step up that failed, the next one comes later. If it begins at a reduced ``level``, it goes up soon.
    """

    def __init__(self, fps: float, now: float, level: int = 0) -> None:
        self.level = level
        self._period = 1.0 / fps
        self._seen: deque[tuple[float, float]] = deque()  # when a frame was acknowledged, and how long it took
        self._lost: deque[tuple[float, float]] = deque()  # when turns were lost, and how many
        self._changed_at = self._good_since = now
        self._rose_at: float | None = None  # None: nothing was restored since the last step down
        self._patience = _MEASURE_S if level else _PATIENCE_S  # of little load, before a step up

    @property
    def step(self) -> Step:
        return STEPS[self.level]

    def lost(self, turns: float, now: float) -> None:
        """Note that so many ``turns`` (see FrameSelector) passed without a frame, because earlier frames were late."""
        if now - (turns + 1) * self._frame_s > self._changed_at:  # else those before them were of another step
            self._lost.append((now, turns))

    def poll(self, acknowledged: list[Acknowledged], age_s: float, now: float) -> bool:
        """Note the ``acknowledged`` frames, and the age of the oldest in flight; True if the step has changed."""
        self._seen.extend((now, frame.took_s) for frame in acknowledged if frame.sent_at >= self._changed_at)
        for memory in (self._seen, self._lost):
            while memory and now - memory[0][0] > _WINDOW_S:
                memory.popleft()
        is_of_this_step = age_s <= now - self._changed_at  # it was sent since the last change
        if is_of_this_step and age_s > _STUCK_S:
            return self._go_down(max(age_s / self._frame_s, self._load), now)  # the load is at least that of this frame
        if now - self._changed_at < _MEASURE_S or not self._seen:
            self._good_since = now
            return False
        load = self._load
        if load > _FULL:
            return self._go_down(load, now)
        # Time counts as good only while there is a step up that would keep the load at _AIM or below.
        if self.level == 0 or load * STEPS[self.level - 1].cost / self.step.cost > _AIM:
            self._good_since = now
        elif now - self._good_since >= self._patience:
            return self._go_up(now)
        return False

    @property
    def _frame_s(self) -> float:
        """Seconds from one frame to the next at this step."""
        return self._period / float(self.step.rate)

    @property
    def _load(self) -> float:
        """Share of the time for which the connection is busy if every due frame is sent; may be well above 1."""
        if not self._seen:
            return 0.0
        frames = len(self._seen)
        busy = sum(took for _, took in self._seen) / frames / self._frame_s
        lost_share = sum(turns for _, turns in self._lost) / frames
        if lost_share <= _LOST:
            return busy
        return max(busy, 1.0 + lost_share)  # all its time was used, and the lost turns would have needed more

    def _go_down(self, load: float, now: float) -> bool:
        """Reduce as far as necessary; return True if the step has changed.

        A step up that was just tried is undone; the next one has to wait longer.
        """
        lower = range(self.level + 1, len(STEPS))
        affordable = self.step.cost * _AIM / load  # the cost at which the load would be _AIM
        if self._rose_at is not None and now - self._rose_at < _PROBATION_S:
            self._patience = min(_LONGEST_PATIENCE_S, max(_PATIENCE_S, 2 * self._patience))
            if load <= 2 * _FULL:
                affordable = self.step.cost  # the next step costs less: one step down, to where it came from
        self._rose_at = None
        level = next((level for level in lower if STEPS[level].cost <= affordable), len(STEPS) - 1)
        return self._change(level, now)

    def _go_up(self, now: float) -> bool:
        if self._rose_at is not None and now - self._rose_at > _PROBATION_S:
            self._patience = max(_PATIENCE_S, self._patience / 2)
        self._rose_at = now
        return self._change(self.level - 1, now)

    def _change(self, level: int, now: float) -> bool:
        changed = level != self.level
        self.level = level
        self._seen.clear()
        self._lost.clear()
        self._changed_at = self._good_since = now
        return changed
