"""Periods as users type them."""

import time
from datetime import UTC, datetime
from zoneinfo import ZoneInfo

import pytest

from pebble.errors import PebbleError
from pebble.extensions.recordings.files.recorded import FOREVER_NS
from pebble.extensions.recordings.period import parse_period

BERLIN = ZoneInfo("Europe/Berlin")
NOW = datetime(2026, 11, 20, 12, 30, tzinfo=UTC)


def ns(text: str) -> int:
    return int(datetime.fromisoformat(text).timestamp()) * 10**9


@pytest.mark.parametrize(
    ("since", "expected"),
    [
        (None, "1970-01-01T00:00Z"),
        ("10:00", "2026-11-20T10:00Z"),
        ("12:30:01", "2026-11-19T12:30:01Z"),  # the latest one is yesterday's
        ("2026-11-18", "2026-11-18T00:00Z"),
        ("2026-11-18 10:00:30", "2026-11-18T10:00:30Z"),
        ("2026-11-18T10:00+02:00", "2026-11-18T08:00Z"),
        ("-90s", "2026-11-20T12:28:30Z"),
        (" -3d ", "2026-11-17T12:30Z"),
        ("0001-01-01T00:00+14:00", "1970-01-01T00:00Z"),
        ("-999999999d", "1970-01-01T00:00Z"),
        ("1969-12-31", "1970-01-01T00:00Z"),
    ],
)
def test_since(since, expected):
    assert parse_period(since, None, now=NOW) == (ns(expected), FOREVER_NS)


@pytest.mark.parametrize(
    ("since", "until", "expected"),
    [
        ("10:00", "13:00", "2026-11-20T13:00Z"),  # may be later than now
        ("22:00", "06:00", "2026-11-20T06:00Z"),  # from yesterday
        ("10:00", "10:00", "2026-11-21T10:00Z"),
        ("10:00", "+5m", "2026-11-20T10:05Z"),
        ("2026-11-18", "2026-11-18", "2026-11-19T00:00Z"),  # the whole day
        ("2026-11-18", "2026-11-18T10:00", "2026-11-18T10:00Z"),
        ("-2h", "-1h", "2026-11-20T11:30Z"),
        (None, "13:00", "2026-11-19T13:00Z"),
    ],
)
def test_until(since, until, expected):
    assert parse_period(since, until, now=NOW)[1] == ns(expected)


def test_fractions_are_exact():
    assert parse_period("10:00:00.123456", None, now=NOW)[0] == ns("2026-11-20T10:00Z") + 123_456_000


def test_a_day_is_23_hours_long_when_clocks_go_forward():
    now = datetime(2026, 11, 20, 12, 30, tzinfo=BERLIN)
    since, until = parse_period("2026-03-29", "2026-03-29", now=now)
    assert until - since == 23 * 3600 * 10**9


@pytest.fixture
def machine_in_berlin():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TZ", "Europe/Berlin")
        time.tzset()
        yield
    time.tzset()


@pytest.mark.parametrize(
    ("since", "until", "expected"),
    [
        ("10:00 UTC", "+1h", "2026-11-20T10:00Z"),
        ("10:00+02:00", "+1h", "2026-11-20T08:00Z"),
        ("2026-07-01 10:00 America/New_York", "+1h", "2026-07-01T14:00Z"),
        ("2026-07-01T10:00", "+1h", "2026-07-01T08:00Z"),
        ("2026-10-25T02:30+01:00", "03:00", "2026-10-25T01:30Z"),
        ("2026-10-25T02:30", "03:00", "2026-10-25T00:30Z"),  # twice that day: the first one
        ("2026-03-29", "+1d", "2026-03-28T23:00Z"),
        ("2026-03-29T02:30", "+1d", "2026-03-29T01:30Z"),  # never that day: an hour after 01:30
    ],
)
@pytest.mark.parametrize("local", [None, BERLIN])
@pytest.mark.usefixtures("machine_in_berlin")
def test_a_time_is_that_of_its_zone_on_its_day(since, until, expected, local):
    assert parse_period(since, until, now=datetime(2026, 11, 20, 13, 30, tzinfo=local))[0] == ns(expected)


@pytest.mark.parametrize(
    ("since", "until", "message"),
    [
        ("25:00", None, '--since "25:00" is no time: write 10:00,'),
        ("2026-02-30", None, "2026-02-30"),
        ("\u0661\u0660:\u0660\u0660", None, "is no time"),
        ("+5m", None, "is in the future: write -5m"),
        (None, "+5m", "counts from --since"),
        ("10:00 ../../etc/passwd", None, "is no time"),
        ("10:00-11:00", None, 'write --since 10:00 --until 11:00; "10:00 -11:00" is 10:00 in that time zone'),
        (None, "24:61", "+5m or -1h"),
        ("2026-11-20", "2026-11-19", "--until 2026-11-19 is not after --since 2026-11-20"),
        ("10:00", "+0s", "is not after"),
        (None, "1960-01-01", "is before 1970"),
    ],
)
def test_what_is_wrong_is_explained_in_a_line(since, until, message):
    with pytest.raises(PebbleError) as error:
        parse_period(since, until, now=NOW)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("until", ["9999-12-31T23:59-12:00", "+999999999d", "2600-01-01"])
def test_what_is_too_late_for_a_recording_is_the_end_of_time(until):
    assert parse_period("10:00", until, now=NOW)[1] == FOREVER_NS
