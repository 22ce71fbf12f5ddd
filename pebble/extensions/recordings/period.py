"""Periods that a user types: ``--since 10:00 --until +5m``. Pure."""

import re
from datetime import UTC, date, datetime, time, timedelta
from typing import Final, NoReturn

from pebble.errors import PebbleError
from pebble.extensions.recordings.library import FOREVER_NS

#: For the help of options.
SINCE_HELP: Final = (
    "From 10:00 (the latest), 2026-11-20, 2026-11-20T10:00 or -2h (ago). Local time, unless with a zone."
)
UNTIL_HELP: Final = "Until before 11:00, 2026-11-20T11:00, +5m (after --since) or -1h (ago); a day counts as a whole."

_EXAMPLES: Final = "10:00, 2026-11-20, 2026-11-20T10:00, 2026-11-20T10:00Z"
_AGE: Final = re.compile(r"([+-])(\d{1,9})(s|m|h|d)", re.ASCII)
_CLOCK: Final = re.compile(r"\d{1,2}:\d{2}(:\d{2}(\.\d{1,6})?)?", re.ASCII)
_UNIT_NS: Final = {"s": 10**9, "m": 60 * 10**9, "h": 3600 * 10**9, "d": 86_400 * 10**9}
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


def parse_period(since: str | None, until: str | None, *, now: datetime) -> tuple[int, int]:
    """The period from ``since`` to before ``until``, in nanoseconds since 1970; 0 and FOREVER_NS where there is none.

    A time of day is the latest one that is not after ``now``; as ``until`` with a ``since``, the first one after that.
    A day as ``until`` is included. Times without a zone are in that of ``now``, or this machine's if that has none.
    Raises PebbleError with one line that shows how to write it.
    """
    since_ns = 0 if since is None else _since(since.strip(), now)
    until_ns = FOREVER_NS if until is None else _until(until.strip(), since_ns if since else None, now)
    if until_ns <= since_ns:
        raise PebbleError(
            f"--until {until} is not after --since {since}" if since else f"--until {until} is before 1970"
        )
    return since_ns, until_ns


def _since(text: str, now: datetime) -> int:
    if (age := _AGE.fullmatch(text)) is not None:
        if age[1] == "+":
            raise PebbleError(f"--since {text} is in the future: write -{text[1:]} for {text[1:]} ago")
        return _clipped(_ns(now) - _length_ns(age))
    if _CLOCK.fullmatch(text):
        return _latest(_clock("--since", text), now)
    return _ns(_moment("--since", text, now))


def _until(text: str, since_ns: int | None, now: datetime) -> int:
    if (age := _AGE.fullmatch(text)) is not None:
        if age[1] == "-":
            return _clipped(_ns(now) - _length_ns(age))
        if since_ns is None:
            raise PebbleError(f"--until {text} counts from --since: give that, too")
        return _clipped(since_ns + _length_ns(age))
    if _CLOCK.fullmatch(text):
        clock = _clock("--until", text)
        return _latest(clock, now) if since_ns is None else _first_after(clock, since_ns, now)
    moment = _moment("--until", text, now)
    if _is_day(text) and moment.date() < date.max:
        moment += timedelta(days=1)
    return _ns(moment)


def _latest(clock: time, now: datetime) -> int:
    today = _ns(datetime.combine(now, clock, now.tzinfo))
    return today if today <= _ns(now) else _ns(datetime.combine(now - timedelta(days=1), clock, now.tzinfo))


def _first_after(clock: time, since_ns: int, now: datetime) -> int:
    since = (_EPOCH + timedelta(microseconds=since_ns // 1000)).astimezone(now.tzinfo)
    moments = (_ns(datetime.combine(since + timedelta(days=days), clock, now.tzinfo)) for days in range(3))
    return next(ns for ns in moments if ns > since_ns)


def _clock(option: str, text: str) -> time:
    try:
        return time.fromisoformat(f"0{text}" if text[1] == ":" else text)
    except ValueError:
        _refuse(option, text)


def _moment(option: str, text: str, now: datetime) -> datetime:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        _refuse(option, text)
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=now.tzinfo)


def _is_day(text: str) -> bool:
    try:
        date.fromisoformat(text)
    except ValueError:
        return False
    return True


def _refuse(option: str, text: str) -> NoReturn:
    more = "+5m or -1h" if option == "--until" else "or -2h"
    raise PebbleError(f'{option} "{text}" is no time: write {_EXAMPLES}, {more}')


def _length_ns(age: re.Match[str]) -> int:
    return int(age[2]) * _UNIT_NS[age[3]]


def _ns(moment: datetime) -> int:
    """Exact, unlike ``timestamp()``. A naive ``moment`` is in this machine's zone."""
    try:
        return _clipped((moment.astimezone(UTC) - _EPOCH) // timedelta(microseconds=1) * 1000)
    except (OverflowError, ValueError):  # the years 1 and 9999, near the ends of what a datetime holds
        return 0 if moment.year <= _EPOCH.year else FOREVER_NS


def _clipped(ns: int) -> int:
    return max(0, min(FOREVER_NS, ns))
