"""The small parts: times that wrap, the dead-man's switch, lights, gears, the motor shield, the settings file."""

import os

from benjr.motor_shield import FREQUENCY, turn
from common.deadman import DeadMan
from common.light import Light
from common.settings import base, get, load
from common.ticks import Grid, add, diff
from fred.gears import Gears

WRAP = 1 << 30
LAST = WRAP - 1


def test_differences_go_over_the_wrap_and_see_as_far_as_half_the_period() -> None:
    for later, earlier, ms in ((5, 3, 2), (3, 5, -2), (2, LAST, 3), (LAST, 2, -3), (LAST, LAST, 0)):
        assert diff(later, earlier) == ms, (later, earlier)
    assert diff((1 << 29) - 1, 0) == (1 << 29) - 1
    assert diff(1 << 29, 0) == -(1 << 29)


def test_a_grid_is_due_once_per_period_makes_up_for_nothing_and_is_delayed_by_nothing() -> None:
    for start in (0, LAST - 50):
        grid = Grid(100, start)
        times = (0, 99, 100, 101, 135, 199, 207, 299, 300, 1250, 1251, 1299, 1300)
        assert [ms for ms in times if grid.due(add(start, ms))] == [100, 207, 300, 1250, 1300]


def test_the_dead_mans_switch_speaks_once_when_the_time_after_the_last_command_is_over() -> None:
    for start in (1000, LAST - 99):
        man = DeadMan(900)
        assert not man.expired(start), "before any command"
        man.feed(start)
        man.feed(add(start, 800))
        assert [ms for ms in (899, 1699, 1700, 1701) if man.expired(add(start, ms))] == [1700]
        assert man.trips == 1
        man.feed(start)
        man.rest()
        assert not man.expired(add(start, 5000))


def test_before_the_first_command_it_fades_red_in_two_seconds_and_goes_on_beyond_the_wrap() -> None:
    light = Light(0)
    assert light.colour == (0.0, 0.0, 1.0)
    assert light.period_ms == 2000
    assert [light.level(now) for now in (0, 500, 1000, 1500, 1999, 2000)] == [0, 256, 512, 256, 0, 0]
    light = Light(WRAP - 1250)
    for step in range(100):
        now = (WRAP - 1250 + step * 250) % WRAP
        assert light.level(now) == (0, 128, 256, 384, 512, 384, 256, 128)[step % 8]


def test_a_glow_is_steady_and_periods_have_limits() -> None:
    light = Light(0)
    light.glow(1.0, 0.5, 0.0)
    assert light.colour == (1.0, 0.5, 0.0)
    assert light.level(0) == light.level(777) == 512
    for period_s, period_ms in ((0.0, 50), (-3.0, 50), (1.2345, 1235), (1e9, 3_600_000)):
        light.flash(0.0, 0.0, 0.0, period_s, 0)
        assert light.period_ms == period_ms


#: What Fred's host asks for, as (left, right, milliseconds), and what the motors get for the last one.
GEARS = (
    (((1.0, 1.0, 1000), (-1.0, -1.0, 1000)), (0.0, 0.0)),  # no way back right after a way ahead
    (((1.0, 1.0, 1000), (-1.0, -1.0, 1339)), (0.0, 0.0)),
    (((1.0, 1.0, 1000), (-1.0, -1.0, 1340)), (-0.651, -0.7)),
    (((1.0, 1.0, 0), (-1.0, 0.0, 100)), (-0.465, 0.5)),  # turning stays possible
    (((1.0, 1.0, 0), (1.0, -1.0, 100)), (0.93, -1.0)),
    (((1.0, 0.0, 0), (-1.0, -1.0, 1)), (-0.651, -0.7)),  # as much ahead as turning
    (((1.0, 0.1, 10), (-1.0, -1.0, 11)), (0.0, 0.0)),
)


def test_freds_gears() -> None:
    for asked, expected in GEARS:
        gears = Gears()
        for one in asked:
            pair = gears.limit(*one)
        assert abs(pair[0] - expected[0]) + abs(pair[1] - expected[1]) < 1e-6, asked


def test_the_messages_of_benjrs_motor_shield() -> None:
    assert bytes((0, 0, 1000 >> 8, 1000 & 255)) == FREQUENCY
    for motor, speed, message in (
        (0, 1.0, b"\x10\x02\x27\x10"),  # clockwise, 100.00 %
        (1, -0.5, b"\x11\x01\x13\x88"),  # the other way, 50.00 %
        (0, 0.0, b"\x10\x03\0\0"),
        (1, 0.00001, b"\x11\x03\0\0"),  # less than the shield can do
    ):
        assert turn(motor, speed) == message, speed


_FILE = "settings-of-a-test.json"
_JSON, _LACKS = "is no JSON", "lacks wifi.ssid"


def _why(written) -> str:
    """What is reported about a file with these bytes, or about none."""
    if written is not None:
        with open(_FILE, "wb") as file:  # noqa: PTH123 - boards have no pathlib
            file.write(written)
    try:
        return "ssid " + get(load(_FILE), "wifi", "ssid")
    except ValueError as error:
        return str(error)
    finally:
        if written is not None:
            os.remove(_FILE)  # noqa: PTH107


def test_what_is_wrong_with_a_file_is_named() -> None:
    for written, why in (
        (b'{"wifi": {"ssid": "Lab"}}', "ssid Lab"),
        (b'\xef\xbb\xbf{"wifi": {"ssid": "Lab"}}\r\n', "ssid Lab"),
        (None, _LACKS),
        (b"{}", _LACKS),
        (b'{"wifi": {"ssid": null}}', _LACKS),
        (b"", _JSON),
        (b"{'wifi': {'ssid': 'Lab'}}", _JSON),
        (b'\xff\xfe{\0"\0w\0"\0:\x001\0}\0', _JSON),
        (b"[]", _LACKS),
        (b'{"wifi": ["Lab"]}', _LACKS),
    ):
        found = _why(written)
        assert why in found, (written, found)


def test_the_base_of_all_topics_and_names_that_would_be_other_topics() -> None:
    assert base("pebble", "robots", "benjr") == b"pebble/robots/benjr"
    for name in ("", "a/b", "+", "a#", 'a"b', "a\\b", "a\nb"):
        for parts in ((name, "robots", "id"), ("pebble", name, "id"), ("pebble", "robots", name)):
            try:
                base(*parts)
            except ValueError:
                continue
            raise AssertionError(parts)
