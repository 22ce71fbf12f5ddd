"""The health of one device: its thread writes it, the service reports it. Times are passed in."""

from typing import Final

from msgspec.structs import replace

from pebble.contract.payloads import MediaReport
from pebble.extensions.media.frames import FrameInfo
from pebble.extensions.media.rate_meter import RateMeter
from pebble.runtime.source_check import SourceCheck

_OPENING_S = 15.0  # a device that takes longer to open hangs
_SILENCE_S = 4.0  # as does one without a frame for so long; a second more than the sources' own timeout
FIRST_DELAY_S, _LONGEST_DELAY_S = 2.0, 30.0  # before a device that failed is opened again
_REMEMBERED = 8  # frames: a driver that hangs may give its buffers in turn
_GOOD_RUN_S = 10.0  # after which a failure is the first again

NOTHING: Final = ""  # the content of sound that is zeros


class Health:
    """The health of a device. One thread at a time writes, any reads. The delay after a failure doubles."""

    def __init__(self, first_delay_s: float = FIRST_DELAY_S, *, computed: bool = False) -> None:
        """Make a record. ``computed``: the device is computed, and its frames may be equal for as long as they like."""
        self._first_delay_s, self._computed = first_delay_s, computed
        self._check = SourceCheck(remembered=_REMEMBERED)
        self._doing = "starts"
        self._deadline: float | None = None  # for the next frame; None: none is expected
        self._opened_at = 0.0
        self._info: FrameInfo | None = None  # of the latest frame; None while there are none
        self._meter = RateMeter()
        self._failures = 0  # in a row
        self._restarts = 0
        self._dropped = 0
        self._last_error: str | None = None

    # -- the device's thread

    def idle(self) -> None:
        self._no_frames("rests: nobody reads")

    def opening(self, now: float) -> None:
        self._no_frames("opens the device")
        self._restarts += self._failures > 0
        self._opened_at = now
        self._deadline = now + _OPENING_S

    def frame(self, info: FrameInfo, now: float, *, skipped: int = 0, content: int | str | None = None) -> None:
        """Note a frame. ``content`` differs between frames with different bytes; None: it was not computed."""
        self._dropped += skipped
        if content is not None or self._info is None:  # without content ``info`` has only the size that was asked for
            self._info = info
        if content is not None:
            self._check.take(content, now)
        self._doing = "runs"
        self._meter.add(now)
        self._deadline = now + _SILENCE_S
        if now - self._opened_at >= _GOOD_RUN_S:
            self._failures = 0

    def failed(self, why: str, *, expected: bool = False) -> float:
        """Note a failure; return the seconds until the next try: the first delay if the failure was ``expected``."""
        doublings = 0 if expected else self._failures
        delay: float = min(self._first_delay_s * 2**doublings, max(_LONGEST_DELAY_S, self._first_delay_s))
        self._failures = min(doublings + 1, 32)  # more than enough for the longest delay
        self._last_error = why
        self._no_frames(f"failed, opens it again in {delay:g} s")
        return delay

    # -- the service's thread

    def overdue(self, now: float) -> bool:
        """True if the device should have opened by now, or should have given a frame."""
        deadline = self._deadline
        return deadline is not None and now > deadline

    @property
    def problem(self) -> str:
        """Problem of the frames that come, in words: for how long they have been the same. Empty if there is none."""
        check, info = self._check, self._info
        if info is None or self._computed or not check.repeats:
            return ""
        what = "gives the same sound" if info.rate else "shows the same picture"
        if check.content == NOTHING:
            what = "gives only zeros, as one that is muted or unplugged,"
        elif check.alternates:
            what = f"{what}s again and again"
        return f"{what} since {check.same_s:.0f} s"

    def report(self, now: float) -> MediaReport:
        info = self._info
        problem = self.problem or None
        report = MediaReport(
            running=info is not None,
            doing=self._doing,
            restarts=self._restarts,
            dropped=self._dropped,
            problem=problem,
            last_error=problem or self._last_error,
        )
        if info is None:
            return report
        rate = round(self._meter.rate(now), 1)
        return replace(report, encoding=info.format, rate=rate, width=info.width or None, height=info.height or None)

    def _no_frames(self, doing: str) -> None:
        self._doing, self._info, self._deadline = doing, None, None
        self._meter.clear()
        self._check.clear()
