"""A jitter buffer: takes packets as the network delivers them, and returns sound in order, evenly, without gaps.

Pure. Times are seconds on the caller's monotonic clock. One thread at a time may call a buffer.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from pebble.errors import PayloadError
from pebble.extensions.media.packets import SEQUENCE_LIMIT, Sound
from pebble.extensions.media.pcm import Samples, to_int16
from pebble.extensions.media.sound import DecodedSound, ReceivedSound, SoundDecoder, unpack
from pebble.transports.counters import Counters

_NUMBERS: Final = SEQUENCE_LIMIT - 1  # 1 to 0xFFFFFFFF: 0 is not used
_BEHIND_LIMIT: Final = 5  # packets in a row that seem old: the sender restarted, and its clock went back
_GAP_LIMIT: Final = 1000  # of missing packets that count as lost
_BYTES_LIMIT: Final = 4_000_000  # that wait, whatever the number of packets
_PIECE_S: Final = 0.02  # what is concealed at a time, so that a late packet is soon played
_ROUNDING_S: Final = 1e-6  # of sums of durations
_FADE_S: Final = 0.005  # back from concealed sound, and over what was left out
_DELAY_LIMIT_S: Final = 0.2  # a caller that takes this late does not have to catch up


@dataclass(frozen=True, slots=True)
class Chunk(DecodedSound):
    """The sound to play next."""

    concealed: bool = False


def ahead(sequence: int, of: int) -> int:
    """Return how many packets ``sequence`` is after ``of``, 1 for the next; negative if it is older."""
    distance = (sequence - of) % _NUMBERS
    return distance if distance <= _NUMBERS // 2 else distance - _NUMBERS


class Depth:
    """The amount of sound that should wait: enough for the network's jitter, and no more.

    A late packet raises the target by its lateness; calm times lower it again. Sound above the target in a whole window
    is left out: the sender's clock is faster than the player's, or a stall has ended.
    """

    WINDOW_S = 1.0
    HIGHEST_S = 0.3
    _CALM_S = 10.0  # without a late packet before the target is lowered by one step
    _STEP_S = 0.01

    def __init__(self, target_s: float) -> None:
        self.target_s = self._least_s = target_s
        self._lowest = float("inf")  # seconds of sound that waited at least, in this window
        self._window_began = self._calm_since = float("-inf")

    def begin(self, now: float) -> None:
        self._lowest, self._window_began, self._calm_since = float("inf"), now, now

    def late(self, seconds: float, now: float) -> None:
        """Note that a packet came so late: raise the target by it."""
        self.target_s = max(self._least_s, min(self.target_s + seconds, self.HIGHEST_S))
        self._calm_since = now

    def excess(self, waiting_s: float, now: float) -> float:
        """Return the seconds of sound to leave out now, while ``waiting_s`` seconds wait. Usually 0."""
        self._lowest = min(self._lowest, waiting_s)
        if now - self._calm_since >= self._CALM_S:
            self.target_s, self._calm_since = max(self._least_s, self.target_s - self._STEP_S), now
        if now - self._window_began < self.WINDOW_S:
            return 0.0
        excess = self._lowest - self.target_s
        self._lowest, self._window_began = float("inf"), now
        return max(0.0, excess)


class JitterBuffer:
    """A buffer: :meth:`put` packets as they arrive; :meth:`take` the sound to play, and write it to the player at once.

    At most ``limit`` packets wait; then the oldest is dropped for the newest. A gap is filled with at most
    ``concealment_ms`` of estimated sound, which fades; then the next received packet is played, or nothing if the
    sender has stopped.

    ``counters``: packets (played), refused, duplicates, late, lost, overflow, skipped (left out to keep up), underruns,
    jumps, restarts (of the sender), concealed_ms.
    """

    def __init__(self, *, limit: int = 48, concealment_ms: int = 100, target_ms: int = 60) -> None:
        self.counters = Counters()
        self.encoding = ""  # of what was played last
        self._limit, self._budget_s = limit, concealment_ms / 1000
        self._depth = Depth(target_ms / 1000)
        self._decoder = SoundDecoder()
        self._waiting: dict[int, Sound] = {}  # by sequence number
        self._expected: int | None = None  # the number that is played next; None before the first
        self._newest_ms = 0  # the latest capture time of a packet
        self._behind = 0  # packets in a row that seemed old
        self._playing = False
        self._due = 0.0  # when the next chunk is to be played
        self._last: ReceivedSound | None = None  # the packet that was played last
        self._concealed = 0  # samples of estimated sound since that packet
        self._spare: Samples | None = None  # concealed by the codec and not played yet

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def waiting_s(self) -> float:
        return sum(sound.samples / sound.rate for sound in self._waiting.values())

    # -- in

    def put(self, payload: bytes, now: float) -> None:
        """Add one MQTT payload."""
        try:
            sound = unpack(payload)
        except PayloadError:
            self.counters.add("refused")
            return
        number = (sound.sequence - 1) % _NUMBERS + 1  # 0, which is not used, counts as the number before 1
        if self._is_old(number, sound.captured_ms):
            self.counters.add("late")
            return
        if number in self._waiting:
            self.counters.add("duplicates")
            return
        if not self._playing and not self._waiting:
            self._due = now + self._depth.target_s
        self._waiting[number] = sound
        self._newest_ms = max(self._newest_ms, sound.captured_ms)
        self._make_room()

    def _is_old(self, number: int, captured_ms: int) -> bool:
        """True if this packet was played or given up.

        False, and everything starts anew, if the sender has restarted: the packet was captured later than all so far,
        or too many in a row seemed old.
        """
        if self._expected is None or ahead(number, self._expected) >= 0:
            self._behind = 0
            return False
        self._behind += 1
        if captured_ms <= self._newest_ms and self._behind < _BEHIND_LIMIT:
            return True
        self.counters.add("restarts")
        self._waiting.clear()
        self._expected, self._newest_ms, self._behind = None, 0, 0
        self._playing = False
        return False

    def _make_room(self) -> None:
        while len(self._waiting) > 1 and (
            len(self._waiting) > self._limit or sum(len(sound.body) for sound in self._waiting.values()) > _BYTES_LIMIT
        ):
            del self._waiting[self._first()]
            self.counters.add("overflow")
            if self._expected is not None:
                self._expected = self._first()  # what was left out on purpose is not a gap

    def _first(self) -> int:
        """Return the number of the waiting packet that is to be played first."""
        base = next(iter(self._waiting)) if self._expected is None else self._expected
        return min(self._waiting, key=lambda number: ahead(number, base))

    # -- out

    def wait(self, now: float) -> float | None:
        """Return the seconds until :meth:`take` may have something; None while only an arriving packet helps."""
        if not self._playing and not self._waiting:
            return None
        return max(0.0, self._due - now)

    def take(self, now: float) -> Chunk | None:
        """Return the sound to play now; None if none is due yet, or the buffer has run out."""
        if not self._playing and not self._begin(now):
            return None
        if now < self._due:
            return None
        if now - self._due > _DELAY_LIMIT_S:  # called late: what was due is not caught up
            self._due = now
        chunk = self._next(now)
        if chunk is None:
            self._playing = False
            if self._waiting:  # a damaged packet was due: pause as before the first packet
                self._due = now + self._depth.target_s
            return None
        self._due += chunk.seconds
        return chunk

    def _begin(self, now: float) -> bool:
        if not self._waiting or now < self._due:
            return False
        self._playing, self._due = True, now
        self._last, self._concealed, self._spare = None, 0, None  # the silence before was not a gap
        self._depth.begin(now)
        return True

    def _next(self, now: float) -> Chunk | None:
        """Return the next packet's sound, or estimated sound for a gap before it; None if there is neither."""
        if not self._waiting:
            if self._last is not None and not self._concealed:  # once: later calls have concealed something
                self.counters.add("underruns")
            return self._conceal(self._budget_s)
        number = self._first()
        missing = 0 if self._expected is None else max(0, ahead(number, self._expected))
        if missing and self._last is not None:
            concealed = self._conceal(missing * self._last.seconds)
            if concealed is not None:
                return concealed
        if missing > _GAP_LIMIT:
            self.counters.add("jumps")
        elif missing:
            self.counters.add("lost", missing)
        elif self._concealed and self._last is not None:  # the packet came late, after estimated sound in its place
            self._depth.late(self._concealed / self._last.rate, now)
        return self._play(number, now)

    def _play(self, number: int, now: float) -> Chunk | None:
        """Return the sound of a waiting packet, or of a later one if too much waits; of a damaged one an estimate."""
        received = self._decode(number)
        excess = self._depth.excess(self.waiting_s, now)
        if received is not None and excess > received.seconds - _ROUNDING_S:
            received = self._leave_out(received, excess)
        if received is None:
            return self._conceal(self._budget_s)
        samples = received.samples
        # Opus goes on smoothly from its own estimate. For pcm the last packet is repeated, and breaks off anywhere.
        if self._concealed and self._last is not None and received.encoding == "pcm":
            samples = _faded_in(samples, received.rate)
        self._last, self._concealed, self._spare = received, 0, None
        self.encoding = received.encoding
        return Chunk(samples, received.rate, received.channels)

    def _decode(self, number: int) -> ReceivedSound | None:
        """Return the sound of a waiting packet; None if it is damaged or empty."""
        sound = self._waiting.pop(number)
        self._expected = number % _NUMBERS + 1
        try:
            received = self._decoder.decode(sound)
        except PayloadError:
            self.counters.add("refused")
            return None
        self.counters.add("packets")
        return received if len(received.samples) else None

    def _leave_out(self, received: ReceivedSound, excess: float) -> ReceivedSound:
        """Skip waiting packets of ``excess`` seconds; return the next, faded over from ``received``."""
        newest, remaining_s = received, excess
        while self._waiting and remaining_s > newest.seconds - _ROUNDING_S:
            remaining_s -= newest.seconds
            newest = self._decode(self._first()) or newest
            self.counters.add("skipped")
        return _faded_over(received, newest)

    def _conceal(self, gap_s: float) -> Chunk | None:
        """Return a piece of estimated sound; None when the gap is filled, or ``concealment_ms`` are used up."""
        last = self._last
        if last is None:
            return None
        budget = round(self._budget_s * last.rate)  # samples, at whose end the sound has faded away
        remaining = round(min(gap_s, self._budget_s) * last.rate) - self._concealed
        size = min(remaining, round(_PIECE_S * last.rate))
        if size <= 0:
            return None
        estimate = self._estimated(last, size)
        gain = 1.0 - (self._concealed + np.arange(len(estimate))) / budget
        self._concealed += len(estimate)
        self.counters.add("concealed_ms", round(1000 * len(estimate) / last.rate))
        return Chunk(to_int16(estimate * gain[:, None]), last.rate, last.channels, concealed=True)

    def _estimated(self, last: ReceivedSound, size: int) -> Samples:
        """Return ``size`` samples of the codec's estimate, else of ``last``, played backwards and forwards in turn."""
        if self._spare is None or not len(self._spare):
            self._spare = self._decoder.conceal()
        if self._spare is not None:
            estimate, self._spare = self._spare[:size], self._spare[size:]
            return estimate
        length = len(last.samples)
        steps = (self._concealed + np.arange(size)) % (2 * length)  # from the end of ``last`` back, then forth again
        return last.samples[np.where(steps < length, length - 1 - steps, steps - length)]


def _faded_in(samples: Samples, rate: int) -> Samples:
    size = min(len(samples), round(_FADE_S * rate))
    faded = samples.copy()
    faded[:size] = to_int16(samples[:size] * np.linspace(0.0, 1.0, size)[:, None])
    return faded


def _faded_over(old: ReceivedSound, new: ReceivedSound) -> ReceivedSound:
    """Return ``new``, with its beginning faded over from ``old``."""
    size = min(len(old.samples), len(new.samples), round(_FADE_S * new.rate))
    if (old.rate, old.channels) != (new.rate, new.channels) or old is new:  # old is new: nothing was skipped
        return new
    weight = np.linspace(0.0, 1.0, size)[:, None]
    samples = new.samples.copy()
    samples[:size] = to_int16(old.samples[:size] * (1 - weight) + new.samples[:size] * weight)
    return ReceivedSound(samples, new.rate, new.channels, new.captured_ms, new.sequence, new.encoding)
