"""References for robots on an impaired network: the paper, one measurement of the original program, our aims. Pure."""

from __future__ import annotations

from typing import Final

#: % of the audio delivered, "saturated near" (paper, section 4.2).
PAPER_BEST_PERCENT: Final = 80.0
PAPER_WORDS: Final = {"512k": "degraded", "256k": "broken"}

#: Table 4.1 of the paper, kbit/s: median and 95th percentile of video, and of audio.
TABLE_4_1: Final = {"fred": (172.46, 283.99, 265.60, 270.91), "goob": (181.18, 588.79, 521.60, 532.03)}
MONO_PCM_KBPS: Final = 265.6  # one channel at 16 kHz: 50 packets of 664 bytes a second

#: Results of the original program by trial, measured once, elsewhere, through such a network: all but fps of the audio.
ORIGINAL: Final = {
    "delivered_percent": {"256k": 40.0, "64k": 5.7},
    "on_time_percent": {"256k": 3.5},  # within a second
    "p95_ms": {"256k": 6900.0},
    "fps": {"256k": 2.2},
}

NARROW: Final = "256k"  # a trial that has aims, and its aims
NARROW_SOUND_PERCENT: Final = 99.0  # delivered, at least
NARROW_SOUND_P95_MS: Final = 400.0
NARROW_PICTURE_GAP_S: Final = 1.0
WORST: Final = "64k+5%"  # another one
WORST_SOUND_PERCENT: Final = 95.0  # delivered, at least
WORST_DRIVE_P95_MS: Final = 500.0
WORST_OFFLINE_S: Final = 2.0
