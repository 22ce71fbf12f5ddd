"""Periods as a user types them: ``--since 10:00 --until +5m``. Pure."""

import re
from datetime import UTC, date, datetime, time, timedelta
from typing import Final, NoReturn
from zoneinfo import ZoneInfo

from pebble.errors import PebbleError
from pebble.extensions.recordings.files.recorded import FOREVER_NS

#: For the help of options.
SINCE_HELP: Final = (
    "From 10:00 (the latest), 2026-11-20, 2026-11-20T10:00 or -2h (ago). Local time; or +01:00, Europe/Rome."
)
UNTIL_HELP: Final = "Until before 11:00, 2026-11-20T11:00, +5m (after --since) or -1h (ago); a day counts as a whole."

_EXAMPLES: Final = '10:00, 2026-11-20, 2026-11-20T10:00, 2026-11-20T10:00Z, "10:00 Europe/Rome"'
_AGE: Final = re.compile(r"([+-])(\d{1,9})(s|m|h|d)", re.ASCII)
_CLOCK: Final = re.compile(r"\d{1,2}:\d{2}(:\d{2}(\.\d{1,6})?)?", re.ASCII)
_ZONED: Final = re.compile(
    r"(?P<time>.*\d)(\s*(?P<offset>Z|[+-]\d{2}:\d{2})|\s+(?P<name>[A-Za-z][A-Za-z0-9_+/-]+))", re.ASCII
)
_RANGE: Final = re.compile(r"(\d{1,2}:\d{2})-(\d{2}:\d{2})", re.ASCII)  # no time with an offset from UTC
_UNIT_NS: Final = {"s": 10**9, "m": 60 * 10**9, "h": 3600 * 10**9, "d": 86_400 * 10**9}
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_DAY: Final = timedelta(days=1)


def parse_period(since: str | None, until: str | None, *, now: datetime) -> tuple[int, int]:
    """Return the period from ``since`` to before ``until``, in nanoseconds since 1970.

    None means 0 as ``since``, FOREVER_NS as ``until``. A time of day is the latest one that is not after ``now``; as
    ``until`` with a ``since``, the first one after that. A day as ``until`` is included. Times without a zone are in
    that of ``now``, or this machine's if that has none; one that occurs twice, because clocks are changed, is the
    first. Raises PebbleError with one line that shows how to write it.
    """
    since_ns = 0 if since is None else _since(*_zoned("--since", since.strip(), now))
    until_ns = FOREVER_NS
    if until is not None:
        text, until_now = _zoned("--until", until.strip(), now)
        until_ns = _until(text, since_ns if since else None, until_now)
    if until_ns <= since_ns:
        raise PebbleError(
            f"--until {until} is not after --since {since}" if since else f"--until {until} is before 1970"
        )
    return since_ns, until_ns


def _zoned(option: str, text: str, now: datetime) -> tuple[str, datetime]:
    """Return the text without its time zone, and ``now`` in that zone."""
    if (both := _RANGE.fullmatch(text)) is not None:
        meant = f'"{both[1]} -{both[2]}" is {both[1]} in that time zone'
        raise PebbleError(f"{option} {text} may be a period: write --since {both[1]} --until {both[2]}; {meant}")
    match = _ZONED.fullmatch(text)
    if match is None:
        return text, now
    try:
        name, offset = match["name"], match["offset"]
        zone = ZoneInfo(name) if name else datetime.fromisoformat(f"2000-01-01T00:00{offset}").tzinfo
        return match["time"], now.astimezone(zone)
    except (LookupError, ValueError, OSError):
        _refuse(option, text)


def _since(text: str, now: datetime) -> int:
    if (age := _AGE.fullmatch(text)) is not None:
        if age[1] == "+":
            raise PebbleError(f"--since {text} is in the future: write -{text[1:]} for {text[1:]} ago")
        return _clipped(_ns(now) - _length_ns(age))
    return _latest("--since", text, now) if _CLOCK.fullmatch(text) else _moment("--since", text, now)


def _until(text: str, since_ns: int | None, now: datetime) -> int:
    """Return the end of a period: ``-5m`` (5 min ago), ``+5m`` (after ``since_ns``), a date, a moment or a time of day.

    A date means its end. A time of day is the next one after ``since_ns``; without ``since_ns``, the latest one.
    """
    if (age := _AGE.fullmatch(text)) is not None:
        if age[1] == "-":
            return _clipped(_ns(now) - _length_ns(age))
        if since_ns is None:
            raise PebbleError(f"--until {text} counts from --since: give that, too")
        return _clipped(since_ns + _length_ns(age))
    if not _CLOCK.fullmatch(text):
        return _moment("--until", text, now, days=1)
    if since_ns is None:
        return _latest("--until", text, now)
    # If ``now`` has no zone, astimezone(None) gives ``since`` a fixed offset, this machine's at that time. ``replace``
    # removes it: ``moment`` may come after a change to summer time, and then has another one.
    since = (_EPOCH + timedelta(microseconds=since_ns // 1000)).astimezone(now.tzinfo).replace(tzinfo=now.tzinfo)
    moment = _time_of_day("--until", text, since)
    return _ns(moment if moment > since else moment + _DAY)


def _latest(option: str, text: str, now: datetime) -> int:
    moment = _time_of_day(option, text, now)
    return _ns(moment if moment <= now else moment - _DAY)


def _time_of_day(option: str, text: str, day: datetime) -> datetime:
    try:
        clock = time.fromisoformat(f"0{text}" if text[1] == ":" else text)
    except ValueError:
        _refuse(option, text)
    return datetime.combine(day, clock, day.tzinfo)


def _moment(option: str, text: str, now: datetime, days: int = 0) -> int:
    """Return the time in a text, in nanoseconds since 1970. Raises PebbleError.

    A date without a time means its beginning, plus ``days``.
    """
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        _refuse(option, text)
    moment = moment if moment.tzinfo is not None else moment.replace(tzinfo=now.tzinfo)
    is_day = len(text) <= len("2026-11-20") and "T" not in text  # else it has a time
    if is_day and moment.date() < date.max:  # there is no day after date.max
        moment += days * _DAY
    return _ns(moment)


def _refuse(option: str, text: str) -> NoReturn:
    more = "+5m or -1h" if option == "--until" else "or -2h"
    raise PebbleError(f'{option} "{text}" is no time: write {_EXAMPLES}, {more}')


def _length_ns(age: re.Match[str]) -> int:
    return int(age[2]) * _UNIT_NS[age[3]]


def _ns(moment: datetime) -> int:
    """Return the exact nanoseconds. A ``moment`` without a zone is in this machine's."""
    try:
        whole_s = int(moment.replace(microsecond=0).timestamp())  # astimezone() is wrong where clocks skip an hour
        return _clipped(whole_s * 10**9 + moment.microsecond * 1000)
    except (OverflowError, ValueError, OSError):  # the years 1 and 9999, near the ends of what a datetime holds
        return 0 if moment.year <= _EPOCH.year else FOREVER_NS


def _clipped(ns: int) -> int:
    return max(0, min(FOREVER_NS, ns))
