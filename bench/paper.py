"""References for robots on an impaired network: the paper, one measurement of the original program, our aims. Pure."""

from __future__ import annotations

from typing import Final, NamedTuple

#: % of the audio delivered, "saturated near" (paper, section 4.2).
PAPER_BEST_PERCENT: Final = 80.0
PAPER_WORDS: Final = {"512k": "degraded", "256k": "broken"}

#: Table 4.1 of the paper, kbit/s: median and 95th percentile of video, and of audio.
TABLE_4_1: Final = {"fred": (172.46, 283.99, 265.60, 270.91), "goob": (181.18, 588.79, 521.60, 532.03)}
MONO_PCM_KBPS: Final = 265.6  # one channel at 16 kHz: 50 packets of 664 bytes a second


class Original(NamedTuple):
    """Results of the original program in one trial; None: not recorded."""

    delivered_percent: float  # of the audio
    on_time_percent: float | None = None  # within a second
    p95_s: float | None = None  # of the audio
    fps: float | None = None


#: Measured once, elsewhere, through such a network.
ORIGINAL: Final = {"256k": Original(40.0, on_time_percent=3.5, p95_s=6.9, fps=2.2), "64k": Original(5.7)}
QUOTED: Final = (
    "Quoted, not measured here:",
    "  the original program, once through such a network: at 256k 40 % of its audio arrived (3.5 % within 1 s, p95 6.9 "
    "s) and 2.2 pictures a second; at 64k 5.7 % of its audio.",
    "  the paper (4.2): audio delivery about 80 % at best, degraded at 512k, broken by 256k.",
)

NARROW: Final = "256k"  # a trial that has aims, and its aims
NARROW_SOUND_PERCENT: Final = 99.0  # delivered, at least
NARROW_SOUND_P95_MS: Final = 400.0
NARROW_PICTURE_GAP_S: Final = 1.0
WORST: Final = "64k+5%"  # another one
WORST_SOUND_PERCENT: Final = 95.0  # delivered, at least
WORST_DRIVE_P95_MS: Final = 500.0
WORST_OFFLINE_S: Final = 2.0
