"""Do the pictures and the sound that arrived match those that were generated? Assessed by their content. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

TOLERANCE = 0.15  # of the camera's rate and of the promised one: the check is short and the machine busy
LEGIBLE = 0.9  # share of the pictures whose counter must be readable
PCM_CORRELATION = 0.95  # of the samples
OPUS_CORRELATION = 0.9  # of the envelopes: Opus preserves the sound, not the waveform
_ENVELOPE_S = 0.02
_FEWEST = 5  # pictures for an assessment

Samples = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ShownPicture:
    """One received picture: epoch seconds of its capture, and the counter in it (None: illegible)."""

    captured_s: float
    counter: int | None


@dataclass(frozen=True, slots=True)
class MediaResult:
    """One encoding of one robot's video or audio: what was measured, and its defects (empty: none).

    ``few`` are those of a machine that cannot keep up: less arrived than should. They are no defects if it was
    ``overloaded``, which says by what.
    """

    robot: str
    encoding: str
    measured: str
    wrong: tuple[str, ...]
    few: tuple[str, ...] = ()
    judged: bool = True
    overloaded: str = ""

    def on(self, overloaded: str) -> MediaResult:
        """The final judgement: ``overloaded`` says why the machine could not keep up; empty: it could."""
        if overloaded and self.few:
            return replace(self, few=(), overloaded=overloaded)
        return replace(self, wrong=(*self.wrong, *self.few), few=())


def watched(robot: str, encoding: str) -> MediaResult:
    """A person has chosen the encoding meanwhile, so that nothing can be said of this one."""
    return MediaResult(robot, encoding, "watched from the page", (), judged=False)


def assess_pictures(
    robot: str, encoding: str, shown: Sequence[ShownPicture], camera_fps: float, fps: float
) -> MediaResult:
    """Requires that the counter advances at the camera's rate, never falls back, and that ``fps`` pictures arrive."""
    legible = [(one.captured_s, one.counter) for one in shown if one.counter is not None]
    if len(legible) < _FEWEST:
        problem = (f"{encoding}: only {len(legible)} legible pictures",)
        too_few = len(shown) < _FEWEST
        return MediaResult(robot, encoding, f"{len(shown)} pictures", () if too_few else problem, problem[:too_few])
    counters = [counter for _, counter in legible]
    seconds = legible[-1][0] - legible[0][0]
    advance = (counters[-1] - counters[0]) / seconds if seconds > 0 else 0.0
    wrong = []
    if len(legible) < LEGIBLE * len(shown):
        wrong.append(f"{encoding}: the counter of {len(shown) - len(legible)} of {len(shown)} pictures is illegible")
    if any(later <= earlier for earlier, later in pairwise(counters)):
        wrong.append(f"{encoding}: the frame counter fell back")
    if abs(advance - camera_fps) > TOLERANCE * camera_fps:
        wrong.append(f"{encoding}: the frame counter advances by {advance:.1f} a second instead of {camera_fps:g}")
    delivered = assess_rate(robot, encoding, [one.captured_s for one in shown], fps)
    measured = f"{delivered.measured}, counter {advance:.2f}/s"
    return MediaResult(robot, encoding, measured, (*wrong, *delivered.wrong), delivered.few)


def assess_rate(robot: str, encoding: str, captured_s: Sequence[float], fps: float) -> MediaResult:
    """Requires that ``fps`` pictures arrive, by the times of their capture."""
    if len(captured_s) < _FEWEST:
        return MediaResult(robot, encoding, f"{len(captured_s)} pictures", (), (f"{encoding}: too few pictures came",))
    seconds = captured_s[-1] - captured_s[0]
    delivered = (len(captured_s) - 1) / seconds if seconds > 0 else 0.0
    problem = (f"{encoding}: {delivered:.1f} pictures a second instead of {fps:g}",)
    few, many = delivered < fps * (1 - TOLERANCE), delivered > fps * (1 + TOLERANCE)
    return MediaResult(robot, encoding, f"{delivered:.1f} fps", problem[:many], problem[:few])


def assess_sound(robot: str, encoding: str, received: Samples, made: Samples, rate: int) -> MediaResult:
    """Requires that ``received`` occurs in the longer ``made``; both are mono samples, ``rate`` per second."""
    if len(received) < rate:
        problem = f"{encoding}: too little sound came without a gap"
        return MediaResult(robot, encoding, f"{len(received) / rate:.1f} s", (), (problem,))
    if encoding == "pcm":
        likeness, needed, what = best_match(received, made), PCM_CORRELATION, "samples"
    else:
        likeness = best_match(envelope(received, rate), envelope(made, rate))
        needed, what = OPUS_CORRELATION, "envelopes"
    wrong = [] if likeness >= needed else [f"{encoding}: the {what} correlate by {likeness:.3f} only"]
    return MediaResult(robot, encoding, f"{len(received) / rate:.1f} s, correlation {likeness:.3f}", tuple(wrong))


def envelope(samples: Samples, rate: int) -> Samples:
    """Loudness in steps of 20 ms."""
    step = int(rate * _ENVELOPE_S)
    whole = samples[: len(samples) // step * step].reshape(-1, step)
    loudness: Samples = np.sqrt(np.mean(whole**2, axis=1))
    return loudness


def best_match(part: Samples, whole: Samples) -> float:
    """The highest normalised correlation (-1..1) of ``part`` with any stretch of ``whole`` of the same length."""
    count = len(part)
    if count == 0 or count > len(whole):
        return 0.0
    centred = part - part.mean()
    size = 1 << (len(whole) + count - 1).bit_length()
    products = np.fft.irfft(np.fft.rfft(whole, size) * np.conj(np.fft.rfft(centred, size)), size)[
        : len(whole) - count + 1
    ]
    sums = np.concatenate(([0.0], np.cumsum(whole)))
    squares = np.concatenate(([0.0], np.cumsum(whole**2)))
    spread = (squares[count:] - squares[:-count]) - (sums[count:] - sums[:-count]) ** 2 / count
    scale = np.sqrt(np.maximum(spread, 0.0) * np.sum(centred**2))
    return float(np.max(np.divide(products, scale, out=np.zeros_like(products), where=scale > 1e-9)))
