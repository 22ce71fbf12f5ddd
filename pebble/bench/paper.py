"""What robots behind a bad link are held against: the paper's words, the original as once measured, our aims. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

#: % of the audio, "saturated near" (section 4.2).
PAPER_BEST_PERCENT: Final = 80.0
PAPER_SAYS: Final = {"512k": "degraded", "256k": "broken"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Original:
    """The original program in one trial; None: nobody wrote it down."""

    delivered_percent: float  # of the audio
    on_time_percent: float | None = None  # within a second
    p95_s: float | None = None  # of the audio
    fps: float | None = None


#: Measured once, through such a link, elsewhere.
ORIGINAL: Final = {
    "256k": Original(delivered_percent=40.0, on_time_percent=3.5, p95_s=6.9, fps=2.2),
    "64k": Original(delivered_percent=5.7),
}

#: The trials that aims are for, and the aims.
NARROW: Final = "256k"
NARROW_SOUND_PERCENT: Final = 99.0  # delivered, at least
NARROW_SOUND_P95_MS: Final = 400.0
NARROW_PICTURE_GAP_S: Final = 1.0
WORST: Final = "64k+5%"
WORST_SOUND_PERCENT: Final = 95.0  # delivered, at least
WORST_DRIVE_P95_MS: Final = 500.0
WORST_OFFLINE_S: Final = 2.0


def _quoted() -> tuple[str, ...]:
    narrow, thin = ORIGINAL["256k"], ORIGINAL["64k"]
    said = ", ".join(f"{word} {'at' if word == 'degraded' else 'by'} {trial}" for trial, word in PAPER_SAYS.items())
    return (
        "Quoted, not measured here:",
        f"  the original program, once through such a link: at 256k {narrow.delivered_percent:g} % of its audio "
        f"arrived ({narrow.on_time_percent:g} % within 1 s, p95 {narrow.p95_s:g} s) and {narrow.fps:g} pictures a "
        f"second; at 64k {thin.delivered_percent:g} % of its audio.",
        f"  the paper (4.2): audio delivery about {PAPER_BEST_PERCENT:g} % at best, {said}.",
    )


#: Both as lines of text.
QUOTED: Final = _quoted()
