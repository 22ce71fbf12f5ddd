"""The health of one device: its thread writes it, the service reports it. Times are passed in."""

from collections.abc import Iterator
from typing import Final

from msgspec import Struct
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
_RATE_S = 5.0  # over which a rate is measured
_SETTLE_S = 2.0  # after the first content, before it is measured
_TOLERANCE = 0.2  # of the rate that was asked


NOTHING: Final = ""  # the content of sound that is zeros


class Asked(Struct, frozen=True):
    """The frames per second, and the width and height of pictures, that a device was asked for; 0: any."""

    rate: float = 0.0
    width: int = 0
    height: int = 0


class RateCheck:
    """A measurement of the rate of a source. One thread writes, any thread reads."""

    def __init__(self, asked_hz: float) -> None:
        """Make a measurement. ``asked_hz``: the rate that was asked for; 0: any."""
        self.wrong_hz: float | None = None  # the measured rate, if another was asked for
        self._asked_hz = asked_hz
        self._window: float | None = None  # when the measurement of the rate began, or, while it settles, will begin
        self._count = 0  # frames in the measurement; -1: it has not begun

    def clear(self) -> None:
        """Forget the source's history, because it was opened again."""
        self.wrong_hz = self._window = None

    def count(self, times: int, now: float) -> None:
        """Count frames. ``times``: how many have come since the last call, also those that were skipped."""
        if self._window is None:
            self._window, self._count = now + _SETTLE_S, -1  # the source settles first
        if now < self._window:
            return
        if self._count < 0:  # settled: what came until now does not count
            self._window, self._count = now, 0
            return
        self._count += times
        seconds = now - self._window
        if seconds >= _RATE_S:
            rate, asked_hz = self._count / seconds, self._asked_hz
            is_wrong = asked_hz > 0 and abs(rate - asked_hz) > max(_TOLERANCE * asked_hz, 1 / seconds)
            self.wrong_hz = rate if is_wrong else None
            self._window, self._count = now, 0


class Health:
    """The health of a device. One thread at a time writes, any reads. The delay after a failure doubles."""

    def __init__(self, first_delay_s: float = FIRST_DELAY_S, asked: Asked | None = None) -> None:
        """Make a record. ``asked``: what a device was asked for; None for a computed one, whose frames may be equal."""
        self._first_delay_s, self._asked = first_delay_s, asked
        self._check, self._rate = SourceCheck(remembered=_REMEMBERED), RateCheck(asked.rate if asked else 0.0)
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
        self._rate.count(1 + skipped, now)
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
    def problems(self) -> dict[str, str]:
        """Problems of the frames that come, by kind."""
        info, asked = self._info, self._asked
        return {} if info is None or asked is None else dict(self._problems(info, asked))

    def _problems(self, info: FrameInfo, asked: Asked) -> Iterator[tuple[str, str]]:
        """Yield each problem of the frames: its kind, and its words."""
        check, sound, wrong_hz = self._check, info.rate > 0, self._rate.wrong_hz
        if check.repeats:
            what = "gives the same sound" if sound else "shows the same picture"
            if check.content == NOTHING:
                what = "gives only zeros, as one that is muted or unplugged,"
            elif check.alternates:
                what = f"{what}s again and again"
            yield "repeats", f"{what} since {check.same_s:.0f} s"
        if wrong_hz is not None and sound:
            samples_hz = wrong_hz / asked.rate * info.rate  # wrong_hz and asked.rate count pieces of sound
            yield "rate", f"gives {samples_hz:.0f} samples a second where {info.rate} were asked"
        elif wrong_hz is not None:
            yield "rate", f"gives {wrong_hz:.1f} pictures a second where {asked.rate:g} were asked"
        if asked.width and (info.width, info.height) != (asked.width, asked.height):
            sizes = f"{info.width}x{info.height} where {asked.width}x{asked.height} were asked"
            yield "size", f"gives pictures of {sizes}"

    def report(self, now: float) -> MediaReport:
        info = self._info
        problem = "; ".join(self.problems.values()) or None
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
        self._rate.clear()
