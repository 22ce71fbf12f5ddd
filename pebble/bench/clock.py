"""How far two machines' clocks are apart, and how surely that is known, from messages there and back. Pure.

A message cannot arrive before it was sent. So the far clock is ahead by at most t2 - t1 (all of it, had the way there
taken no time), and by at least t3 - t4 (had the way back taken none). Every exchange says this; the quickest ones
leave the least room. What is then unknown is how the time of the quickest ways was divided: that is the error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pebble.bench.control_wire import Exchange
from pebble.errors import PebbleError

#: How much faster one clock may run than the other: quartz is within 50 ppm on each side, where NTP does not slew it.
DRIFT = 100e-6
LEAST = 8  # exchanges


@dataclass(frozen=True, slots=True)
class Offset:
    """The far clock is ahead of ours by ``ns``, give or take ``error_ns``, during all of the exchanges."""

    ns: int
    error_ns: int


def estimate(exchanges: Sequence[Exchange], *, drift: float = DRIFT) -> Offset:
    """Best over some seconds: the longer, the more the clocks may drift, which is part of the error.

    Raises PebbleError for fewer than ``LEAST`` exchanges, and where a clock was set meanwhile.
    """
    if len(exchanges) < LEAST:
        raise PebbleError(f"{len(exchanges)} messages came back: two clocks cannot be compared with fewer than {LEAST}")
    begin, end = min(one.t1 for one in exchanges), max(one.t4 for one in exchanges)
    middle = (begin + end) // 2
    most = min(one.t2 - one.t1 + drift * abs(one.t1 - middle) for one in exchanges)
    least = max(one.t3 - one.t4 - drift * abs(one.t4 - middle) for one in exchanges)
    if least > most:
        raise PebbleError("the two clocks do not keep pace: one of them was set while the messages went; measure again")
    error = (most - least) / 2 + drift * (end - begin) / 2
    return Offset(round((most + least) / 2), round(error) + 1)  # 1: what rounding may take


def one_way_ns(exchange: Exchange, offset: Offset) -> tuple[int, int]:
    """The way there and the way back, each give or take the offset's error."""
    return exchange.t2 - exchange.t1 - offset.ns, exchange.t4 - exchange.t3 + offset.ns
