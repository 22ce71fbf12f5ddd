"""The comparisons that do not run on the engine yet: what the report and the pictures need of them.

Their command lines are in pebble.commands, and their runs in modules of their own.
"""

from __future__ import annotations

from pebble.bench.comparison import Budget, Comparison
from pebble.bench.pictures import Drawn, ecdf, null_ratios, ratios

BRIDGE = Comparison(
    name="bridge",
    title="Operator to wheels, and back",
    what="A whole robot of each kind, with a stock broker between it and the operator. Down is from the operator's "
    "publish call to the last byte of the command's line at the MCU's pty; up is from the "
    "MCU's report to the operator.",
    full=Budget(300),
    quick=Budget(22),
    summary_lines=3,
    reported_full=("--with-media",),
    pictures=(ecdf("Operator to wheels and back"), ratios("Operator to wheels and back", "mqtt")),
)
BRIDGE_PROFILE = Comparison(
    name="bridge-profile",
    title="Operator to wheels: where the time goes",
    what="The same path of a command, hop by hop, from the time stamps of its packets on loopback: for a typical "
    "command, and for the slowest ones.",
    full=Budget(60),
    quick=Budget(12),
    root=True,
    words=("bench", "bridge"),
    reported=("--profile",),
    pictures=(ecdf("Operator to wheels, hop by hop"),),
)
BRIDGE_NULL = Comparison(
    name="bridge-null",
    title="Operator to wheels: the null test",
    what="One robot in three roles that take turns: plain, again, and with a fifth of the usual latency planted by "
    "the operator. The first interval must include 1.00, the second must lie above it.",
    full=Budget(150),
    quick=Budget(14),
    words=("bench", "bridge"),
    reported=("--null",),
    pictures=(null_ratios("Null test of bridge"), ecdf("Null test of bridge")),
)
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
