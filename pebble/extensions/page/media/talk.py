"""A person's voice on its way to a robot, as the robot's packets: one talk at a time, nothing late. Pure."""

from typing import Final

from pebble.extensions.media.packets import SEQUENCE_LIMIT, Codec, Sound

RATE: Final = 16_000  # Hz, mono, s16le
PIECES_PER_S: Final = 50
SAMPLES: Final = RATE // PIECES_PER_S
PIECE_BYTES: Final = 2 * SAMPLES
SILENT_S: Final = 1.0  # without a piece that is in time, after which a talk is over
LATE_S: Final = 0.3  # what a stalled connection has held back longer than that is not played
_DRIFT_S: Final = 2e-5  # in each piece: the clock of a page's microphone may be slow by a thousandth


class Talk:
    """A talk of one page. After its end the page must begin another one."""

    def __init__(self, number: int, now: float) -> None:
        self.number = number  # of that page's connection
        self._received_at = now  # of the last piece that was in time
        self._begun_at = float("inf")  # when the page spoke piece 0, as the fastest of its pieces shows

    def takes(self, piece: int, now: float) -> bool:
        """True if piece number ``piece``, from 0, is at most LATE_S later than the fastest; if so, note its time."""
        begun_at = now - piece / PIECES_PER_S  # when the page spoke piece 0, if this piece was not delayed
        # The pieces of a slow microphone come ever later: so the fastest counts as later by _DRIFT_S with each piece.
        self._begun_at = min(self._begun_at + _DRIFT_S, begun_at)
        if begun_at - self._begun_at > LATE_S:
            return False
        self._received_at = now
        return True

    def is_over(self, now: float) -> bool:
        return now - self._received_at > SILENT_S


class Voice:
    """The packets of all talks to one robot, by the server's clock.

    Receivers of the original discard packets with smaller numbers than before, so another talk, or another server, must
    not begin at 1: each talk begins at the number that belongs to its time.
    """

    def __init__(self) -> None:
        self._count = 0

    def begin(self, wall_s: float) -> None:
        self._count = max(self._count, int(PIECES_PER_S * wall_s))

    def packet(self, piece: bytes, wall_s: float) -> bytes:
        self._count += 1
        number = (self._count - 1) % (SEQUENCE_LIMIT - 1) + 1  # 0 is not used
        return Sound(Codec.PCM16LE, 1, RATE, SAMPLES, number, int(1000 * wall_s), piece).pack()
