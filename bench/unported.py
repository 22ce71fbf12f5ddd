"""The comparisons that do not run on the engine yet: what the report and the pictures need of them.

Their command lines are in pebble.commands, and their runs in modules of their own.
"""

from __future__ import annotations

from pebble.bench.comparison import Budget, Comparison
from pebble.bench.pictures import Drawn

IMPAIR = Comparison(
    name="impair",
    title="On an impaired network",
    what="Whole robots whose uplink is limited and loses packets, trial after trial, as in section 4.2 of the "
    "paper: heartbeat, driving, video, then audio in each. “original” is this Pebble with the original's encodings "
    "(JSON video, PCM audio); “h264 opus” are the encodings with rate control.",
    full=Budget(1300),
    quick=Budget(85),
    summary_lines=9,
    words=("impair",),
    pictures=(Drawn("pebble.bench.impair.pictures:over_trials"), Drawn("pebble.bench.impair.pictures:over_time")),
)
