"""Chooses which frames of a camera are sent, and which of these are full pictures. Pure: times are passed in."""

_EARLY = 0.25  # of a period: how far ahead of its turn a frame may be, because cameras have jitter
_LATE = 1.0  # periods that may be made up for; a longer pause is not
PERIOD_S = 1.0  # full pictures are large: one per second, however many receivers request one


class FrameSelector:
    """The turns of frames: times at the configured rate. A frame that is due uses up one turn.

    Times are those of capture. Comparing each frame with the one sent before it would round every wait up to the
    camera's next frame: 15 frames per second reduced to 10 would become 7.5. Turns do not drift: after a frame that was
    sent late, the next one keeps its time.
    """

    def __init__(self, fps: float) -> None:
        self._period = 1.0 / fps
        self._turn: float | None = None  # seconds; None until the first frame
        self._captured = float("-inf")  # of the last frame

    @property
    def fps(self) -> float:
        return 1.0 / self._period

    @fps.setter
    def fps(self, fps: float) -> None:
        self._period = 1.0 / fps
        if self._turn is not None:
            self._turn = min(self._turn, self._captured + self._period)

    def due(self, captured_s: float) -> bool:
        """True if a frame captured at ``captured_s`` has its turn. If the clock went back, turns start again."""
        if captured_s < self._captured:
            self._turn = None
        self._captured = captured_s
        return self._turn is None or captured_s >= self._turn - _EARLY * self._period

    def use(self, captured_s: float) -> float:
        """Use up the frame's turn: the next one is a period later. Return how many turns were missed."""
        turn = captured_s if self._turn is None else self._turn
        missed = max(0.0, (captured_s - turn) / self._period - _LATE)
        self._turn = turn + (1.0 + missed) * self._period
        return missed


class KeyframeRequests:
    """The requests for a full picture since the last one; the next full picture answers them all."""

    def __init__(self) -> None:
        self._requested = self._required = False
        self._sent_at = float("-inf")

    def request(self) -> None:
        """Note that a receiver cannot decode the differences."""
        self._requested = True

    def require(self) -> None:
        """Require a full picture at once: the next picture cannot be a difference from the last one."""
        self._required = True

    def due(self, now: float) -> bool:
        """True if the next picture must be a full one."""
        return self._required or (self._requested and now - self._sent_at >= PERIOD_S)

    def sent(self, now: float) -> None:
        """Note that a full picture was sent, for any reason."""
        self._requested = self._required = False
        self._sent_at = now
