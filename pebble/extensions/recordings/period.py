"""Periods as a user types them: ``--since 10:00 --until +5m``. Pure."""

import re
from collections.abc import Iterator
from datetime import UTC, date, datetime, time, timedelta, tzinfo
from typing import Final, NoReturn
from zoneinfo import ZoneInfo

from pebble.errors import PebbleError
from pebble.extensions.recordings.library import FOREVER_NS

#: For the help of options.
SINCE_HELP: Final = (
    "From 10:00 (the latest), 2026-11-20, 2026-11-20T10:00 or -2h (ago). Local time; or +01:00, Europe/Rome."
)
UNTIL_HELP: Final = "Until before 11:00, 2026-11-20T11:00, +5m (after --since) or -1h (ago); a day counts as a whole."

_EXAMPLES: Final = '10:00, 2026-11-20, 2026-11-20T10:00, 2026-11-20T10:00Z, "10:00 Europe/Rome"'
_AGE: Final = re.compile(r"([+-])(\d{1,9})(s|m|h|d)", re.ASCII)
_CLOCK: Final = re.compile(r"\d{1,2}:\d{2}(:\d{2}(\.\d{1,6})?)?", re.ASCII)
_ZONED: Final = re.compile(
    r"(?P<time>.*\d)(\s*(?P<offset>Z|[+-]\d{2}:\d{2})|\s+(?P<name>[A-Za-z][A-Za-z0-9_+/-]+)|\[(?P<tag>\S+)\])", re.ASCII
)
_UNIT_NS: Final = {"s": 10**9, "m": 60 * 10**9, "h": 3600 * 10**9, "d": 86_400 * 10**9}
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


def parse_period(since: str | None, until: str | None, *, now: datetime) -> tuple[int, int]:
    """Return the period from ``since`` to before ``until``, in nanoseconds since 1970.

    An empty text means 0, or FOREVER_NS. A time of day is the latest one that is not after ``now``; as ``until`` with a
    ``since``, the first one after that. A day as ``until`` is included. Times without a zone are in that of ``now``, or
    this machine's if that has none. Raises PebbleError with one line that shows how to write it, also for a time that
    occurs twice, or never, on that day because clocks are changed.
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
    match = _ZONED.fullmatch(text)
    if match is None:
        return text, now
    name = match["name"] or match["tag"]
    try:
        zone = ZoneInfo(name) if name else datetime.fromisoformat(f"2000-01-01T00:00{match['offset']}").tzinfo
        return match["time"], now.astimezone(zone)
    except (LookupError, ValueError, OSError):
        _refuse(option, text)


def _since(text: str, now: datetime) -> int:
    if (age := _AGE.fullmatch(text)) is not None:
        if age[1] == "+":
            raise PebbleError(f"--since {text} is in the future: write -{text[1:]} for {text[1:]} ago")
        return _clipped(_ns(now) - _length_ns(age))
    if _CLOCK.fullmatch(text):
        return _latest("--since", text, now)
    return _moment("--since", text, now)


def _until(text: str, since_ns: int | None, now: datetime) -> int:
    if (age := _AGE.fullmatch(text)) is not None:
        if age[1] == "-":
            return _clipped(_ns(now) - _length_ns(age))
        if since_ns is None:
            raise PebbleError(f"--until {text} counts from --since: give that, too")
        return _clipped(since_ns + _length_ns(age))
    if _CLOCK.fullmatch(text):
        return _latest("--until", text, now) if since_ns is None else _first_after("--until", text, since_ns, now)
    return _moment("--until", text, now, days=1)


def _latest(option: str, text: str, now: datetime) -> int:
    moments = _times_of_day(_clock(option, text), now, range(-2, 1))
    ns, moment = max(time for time in _known(moments, now.tzinfo) if time[0] <= _ns(now))
    _check_shown(option, text, moment, now.tzinfo)
    return ns


def _first_after(option: str, text: str, since_ns: int, now: datetime) -> int:
    moments = _times_of_day(_clock(option, text), _at(since_ns, now.tzinfo), range(3))
    ns, moment = min(time for time in _known(moments, now.tzinfo) if time[0] > since_ns)
    _check_shown(option, text, moment, now.tzinfo)
    return ns


def _times_of_day(clock: time, around: datetime, days: range) -> list[datetime]:
    return [datetime.combine(around + timedelta(days=day), clock) for day in days]


def _known(moments: list[datetime], zone: tzinfo | None) -> Iterator[tuple[int, datetime]]:
    return ((ns, moment) for moment in moments for ns in _readings(moment, zone))


def _readings(moment: datetime, zone: tzinfo | None) -> set[int]:
    """Return the times at which a zone's clocks show ``moment``: usually one, two or none when they are changed."""
    return {_ns(moment.replace(tzinfo=zone, fold=fold)) for fold in (0, 1)}


def _check_shown(option: str, text: str, moment: datetime, zone: tzinfo | None, *, once: bool = False) -> None:
    readings = sorted(_readings(moment, zone))
    is_shown = _at(readings[0], zone).replace(tzinfo=None, fold=0) == moment
    if is_shown and not (once and len(readings) > 1):
        return
    often = "is twice" if is_shown else "is never"
    forms = " or ".join(_at(ns, zone).isoformat() for ns in readings)
    raise PebbleError(f"{option} {text} {often} on {moment:%Y-%m-%d}, when clocks are changed: write {forms}")


def _at(ns: int, zone: tzinfo | None) -> datetime:
    return (_EPOCH + timedelta(microseconds=ns // 1000)).astimezone(zone)


def _clock(option: str, text: str) -> time:
    try:
        return time.fromisoformat(f"0{text}" if text[1] == ":" else text)
    except ValueError:
        _refuse(option, text)


def _moment(option: str, text: str, now: datetime, days: int = 0) -> int:
    """Return the time in a text, in nanoseconds since 1970. Raises PebbleError.

    A date without a time means its beginning, plus ``days``.
    """
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        _refuse(option, text)
    if _is_day(text):
        begin = moment.replace(tzinfo=now.tzinfo)
        return _ns(begin + timedelta(days=days) if moment.date() < date.max else begin)
    if moment.tzinfo is not None or not 1970 < moment.year < date.max.year:
        return _ns(moment if moment.tzinfo is not None else moment.replace(tzinfo=now.tzinfo))
    _check_shown(option, text, moment, now.tzinfo, once=True)
    return _readings(moment, now.tzinfo).pop()


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
    """Return the exact nanoseconds, unlike ``timestamp()``. A ``moment`` without a zone is in this machine's."""
    try:
        if moment.tzinfo is None:  # astimezone() is wrong where it does not exist
            return _clipped(int(moment.replace(microsecond=0).timestamp()) * 10**9 + moment.microsecond * 1000)
        return _clipped((moment - _EPOCH) // timedelta(microseconds=1) * 1000)
    except (OverflowError, ValueError, OSError):  # the years 1 and 9999, near the ends of what a datetime holds
        return 0 if moment.year <= _EPOCH.year else FOREVER_NS


def _clipped(ns: int) -> int:
    return max(0, min(FOREVER_NS, ns))
