"""Estimates the offset between two machines' clocks, and its error, from round trips of messages. Pure.

A message cannot arrive before it is sent. So the far clock is ahead by at most t2 - t1 (if the way there took no time)
and by at least t3 - t4 (if the way back took none). Each exchange gives these bounds; the fastest ones give the
tightest. How the remaining time is divided between the two ways is unknown: that is the error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pebble.bench.control_ends import Exchange
from pebble.errors import PebbleError

#: The largest relative drift: quartz is within 50 ppm on each side unless NTP slews it.
DRIFT = 100e-6
LEAST = 8  # exchanges


@dataclass(frozen=True, slots=True)
class Offset:
    """The far clock is ahead of ours by ``ns`` ± ``error_ns`` during all of the exchanges."""

    ns: int
    error_ns: int


def estimate(exchanges: Sequence[Exchange], *, drift: float = DRIFT) -> Offset:
    """Works best over some seconds: drift adds to the error with time.

    Raises PebbleError for fewer than ``LEAST`` exchanges, or if a clock was set meanwhile.
    """
    if len(exchanges) < LEAST:
        raise PebbleError(f"{len(exchanges)} messages came back: comparing two clocks needs at least {LEAST}")
    begin, end = min(one.t1 for one in exchanges), max(one.t4 for one in exchanges)
    middle = (begin + end) // 2
    most = min(one.t2 - one.t1 + drift * abs(one.t1 - middle) for one in exchanges)
    least = max(one.t3 - one.t4 - drift * abs(one.t4 - middle) for one in exchanges)
    if least > most:
        raise PebbleError("the two clocks are inconsistent: one of them was set during the measurement; measure again")
    error = (most - least) / 2 + drift * (end - begin) / 2
    return Offset(round((most + least) / 2), round(error) + 1)  # 1: for rounding


def one_way_ns(exchange: Exchange, offset: Offset) -> tuple[int, int]:
    """The times there and back, each ± the offset's error."""
    return exchange.t2 - exchange.t1 - offset.ns, exchange.t4 - exchange.t3 + offset.ns
