"""The distance of a wheel by a hall sensor beside its ring of magnets: a sine, two half waves per pair of poles.

A step is one half wave. Between steps the arcsine of the level gives the phase, so the distance is exact to about a
millimetre. A single sensor does not show the direction: the drive command does. A second sensor a quarter of a wave
away shows it, and is used if it agrees with the commands.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

_SMALLEST_SWING = 30  # ADC counts between the extremes; less is noise
_WARM_UP_EXTREMA = 12  # of the sensor's signal, until its range is known
_WARM_UP_SAMPLES = 400
_FADE = 0.005  # per extremum: how fast the range follows a signal that becomes smaller; a fast wheel shows few peaks
_CARRY = 0.72  # the share of its speed that a wheel keeps over a sample of 20 ms: motors have a lag of about 60 ms
_FULL_SPEED_RAD = 1.25  # phase per sample at full power, until it is known: Goob's
_SMOOTH = 0.4  # per sample
_LEAST_SPEED_RAD = 0.3
_MOST_SPEED_RAD = 1.5  # beyond a quarter of a wave per sample, waves are missed
_NOISE_RAD = 0.8  # how far noise moves a phase back, near the extremes of the wave
_LEARN = 0.05  # per sample: how fast the speed per power is learned
_SHARE_AGREED = 0.7  # of the motion in which two sensors must agree with the commands


class HallSample(NamedTuple):
    """A sample of a wheel: ADC values, the power of its motor (−1..1), and the direction in which it can turn.

    ``quadrature`` is the second sensor's value, if any. ``direction`` 0 means unknown.
    """

    value: int
    quadrature: int | None
    power: float
    direction: int


class SensorRange:
    """The extreme values of a sensor, which differ between sensors and drift."""

    def __init__(self) -> None:
        self.extrema = 0  # so far
        self.low = self.high = 0.0
        self._started = False
        self._rising = True
        self._pivot = 0.0  # the farthest value since the last extremum

    @property
    def swings(self) -> bool:
        return self.high - self.low >= _SMALLEST_SWING

    def update(self, value: float) -> None:
        """Add a value. A half wave has ended once the signal has gone back clearly from its farthest value."""
        if not self._started:
            self._started = True
            self.low = self.high = self._pivot = value
        self.low, self.high = min(self.low, value), max(self.high, value)
        goes_on = value > self._pivot if self._rising else value < self._pivot
        if goes_on:
            self._pivot = value
        elif abs(value - self._pivot) > max(_SMALLEST_SWING, 0.3 * (self.high - self.low)):
            self._end_of_half_wave(value)

    def level(self, value: float) -> float:
        """Return a value as its place in the range, −1..1."""
        middle, swing = (self.low + self.high) / 2, (self.high - self.low) / 2
        return max(-1.0, min(1.0, (value - middle) / swing))

    def _end_of_half_wave(self, value: float) -> None:
        """Count the extreme value, and move that end of the range a little towards it: the signal may now be less."""
        self.extrema += 1
        if self._rising:
            self.high += _FADE * (self._pivot - self.high)
        else:
            self.low += _FADE * (self._pivot - self.low)
        self._rising = not self._rising
        self._pivot = value


class PhaseTracker:
    """The phase of a sine wave, unwrapped, from a sensor's levels and the power that moves the wheel.

    The levels alone fit a wheel that turns backwards just as well. The expected speed decides between the two, and the
    phase never goes back by more than noise explains.
    """

    def __init__(self, *, falls: bool = False) -> None:
        """Start. ``falls``: the first level is on the falling half of the wave, for a wheel that turns forward."""
        self.phase: float | None = None  # None: no sample yet
        self.surprise = 0.0  # the sum of all differences from the expected phases
        self.rejected = 0  # samples that fit a turn against the expected one better
        self._expected = self._measured = 0.0  # speeds: phase per sample
        self._power = 0.0  # of the last sample
        self._per_power = _FULL_SPEED_RAD  # the speed at full power, as far as it is learned
        self._farthest = 0.0  # the farthest phase in the expected direction
        self._falls = falls

    def update(self, level: float, power: float) -> float:
        """Return the phase added since the last level."""
        rising, falling = math.asin(level), math.pi - math.asin(level)  # the level occurs once on each half of the wave
        if self.phase is None:
            self.phase = self._farthest = falling if self._falls else rising
            return 0.0
        predicted = self.phase + self._predict(power)

        def distance(phase: float) -> float:
            return abs(phase - predicted)

        phases = [predicted + math.remainder(half - predicted, math.tau) for half in (rising, falling)]
        nearest = min(phases, key=distance)
        direction = math.copysign(1.0, self._expected)
        possible = [phase for phase in phases if (phase - self._farthest) * direction >= -_NOISE_RAD]
        if nearest not in possible:
            self.rejected += 1
            # if both are too far back, the wheel has turned on, into the next wave
            nearest = min(possible or [phase + direction * math.tau for phase in phases], key=distance)
        self.surprise += distance(nearest)
        return self._move_to(self.phase, nearest, power)

    def update_pair(self, phase: float, power: float) -> float:
        """Return the phase added since the last sample; ``phase``: within its wave, as two sensors show it."""
        if self.phase is None:
            self.phase = self._farthest = phase
            return 0.0
        predicted = self.phase + self._predict(power)
        return self._move_to(self.phase, predicted + math.remainder(phase - predicted, math.tau), power)

    def _predict(self, power: float) -> float:
        """Return the phase that this sample should add: by the power, and by the measured speed if that agrees.

        If the expected direction changes, the phase may go back from now on: the farthest phase reached, behind which
        it must not go, is set to the present one.
        """
        before = self._expected
        mean_power = (self._power + power) / 2  # a command comes between two samples
        self._expected, self._power = _CARRY * before + (1.0 - _CARRY) * self._per_power * mean_power, power
        if before * self._expected <= 0.0 and self.phase is not None:
            self._farthest = self.phase
        agrees = self._measured * self._expected > 0.0
        return (self._expected + self._measured) / 2 if agrees else self._expected

    def _move_to(self, before: float, phase: float, power: float) -> float:
        """Set the new phase and learn from it how fast the wheel is; return the phase added."""
        added = phase - before
        self.phase = phase
        self._measured += _SMOOTH * (added - self._measured)
        self._farthest = max(self._farthest, phase) if self._expected >= 0.0 else min(self._farthest, phase)
        if abs(power) >= 0.1 and abs(self._expected) > 0.9 * self._per_power * abs(power):  # the wheel is up to speed
            learned = self._per_power + _LEARN * (added / power - self._per_power)
            self._per_power = max(_LEAST_SPEED_RAD, min(_MOST_SPEED_RAD, learned))
        return added


@dataclass(slots=True)
class _Counts:
    rad: float = 0.0
    rad_in_any_direction: float = 0.0
    unknown_rad: float = 0.0


class HallWheel:
    """A wheel. ``mm_per_step`` is the distance for half a wave.

    During a warm-up the range of the sensor is not known well. So after each extremum all samples until then are
    tracked again with the better range, which corrects the distance so far.
    """

    def __init__(self, mm_per_step: float) -> None:
        self.mm_per_step = mm_per_step
        self._counts = _Counts()
        self._range, self._second = SensorRange(), SensorRange()
        self._tracker = PhaseTracker()
        self._second_sign = 0  # −1: the second sensor is ahead; 0: it is not used
        self._warm_up: list[HallSample] | None = []  # None: the range is known

    @property
    def ready(self) -> bool:
        """True if the distance so far is final: the warm-up is over, or the wheel has not turned yet."""
        return self._warm_up is None or not self._range.swings

    @property
    def mm(self) -> float:
        """Return the distance so far; reverse is negative."""
        return self._counts.rad / math.pi * self.mm_per_step

    @property
    def steps(self) -> float:
        return self._counts.rad_in_any_direction / math.pi

    @property
    def unknown(self) -> int:
        """Return the number of steps in an unknown direction, which count in no distance."""
        return int(self._counts.unknown_rad / math.pi)

    @property
    def extrema(self) -> int:
        return self._range.extrema

    @property
    def rejected(self) -> int:
        return self._tracker.rejected

    def update(self, sample: HallSample) -> float:
        """Return the distance since the last sample, in mm; in the warm-up with the corrections of earlier ones."""
        extrema_before = self._range.extrema
        self._range.update(sample.value)
        if sample.quadrature is not None:
            self._second.update(sample.quadrature)
        before = self.mm
        if self._warm_up is not None:
            self._warm_up.append(sample)
            if self._range.extrema > extrema_before:
                self._replay(self._warm_up)
                return self.mm - before
            self._bound_warm_up(self._warm_up)
        if self._range.extrema:  # else the range is unknown: the replay at the first extremum adds the sample
            self._add(sample, self._tracker, self._counts)
        return self.mm - before

    def _bound_warm_up(self, samples: list[HallSample]) -> None:
        """Limit the samples that are kept, as a slow wheel shows few extrema.

        If one was seen, end the warm-up with the range so far. Otherwise forget the older half of the samples.
        """
        if len(samples) < _WARM_UP_SAMPLES:
            return
        if self._range.extrema:
            self._warm_up = None
        else:
            del samples[: len(samples) // 2]

    def _replay(self, samples: list[HallSample]) -> None:
        """Track all samples so far again, since the range and the first half of the wave are better known now."""
        self._second_sign = self._sign_of_second(samples)
        rising, falling = (self._replayed(samples, PhaseTracker(falls=falls)) for falls in (False, True))
        self._tracker, self._counts = min(rising, falling, key=lambda replayed: replayed[0].surprise)
        if self._range.extrema >= _WARM_UP_EXTREMA:
            self._warm_up = None

    def _replayed(self, samples: list[HallSample], tracker: PhaseTracker) -> tuple[PhaseTracker, _Counts]:
        counts = _Counts()
        for sample in samples:
            self._add(sample, tracker, counts)
        return tracker, counts

    def _add(self, sample: HallSample, tracker: PhaseTracker, counts: _Counts) -> None:
        """Add a sample's motion, as ``tracker`` finds it, to ``counts``; by both sensors if the second one is used."""
        level = self._range.level(sample.value)
        if self._second_sign and sample.quadrature is not None:
            second = self._second_sign * self._second.level(sample.quadrature)
            added = tracker.update_pair(math.atan2(level, -second), sample.power)  # see _sign_of_second
        else:
            added = tracker.update(level, sample.power)
            if sample.direction == 0:  # not known: the single sensor does not show it
                counts.unknown_rad += abs(added)
                return
        counts.rad += added
        counts.rad_in_any_direction += abs(added)

    def _sign_of_second(self, samples: list[HallSample]) -> int:
        """Return the factor that lets the second sensor's level agree with the commands: 1 or −1; 0 if neither does.

        Also 0 after less motion than half a wave, which shows too little.
        """
        if not self._second.swings or self._second.extrema < 1:
            return 0
        agreed = 0.0  # the motion in the commanded direction; against it: negative
        total = 0.0  # the motion in any direction: the net one of each stretch, as noise goes back and forth
        since_change = 0.0  # the motion since the commanded direction changed
        last_phase, last_direction = 0.0, 0
        for sample in samples:
            if sample.quadrature is None:
                return 0
            # With the factor 1 the first level is the sine of the phase, and the second one, behind it, −cosine.
            phase = math.atan2(self._range.level(sample.value), -self._second.level(sample.quadrature))
            if sample.direction != last_direction:
                total, since_change = total + abs(since_change), 0.0
            elif sample.direction:
                moved = math.remainder(phase - last_phase, math.tau)
                since_change += moved
                agreed += moved * sample.direction
            last_phase, last_direction = phase, sample.direction
        total += abs(since_change)
        if total < math.pi or abs(agreed) < _SHARE_AGREED * total:
            return 0
        return 1 if agreed > 0.0 else -1
