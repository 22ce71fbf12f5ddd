"""Glowing and fading."""

from common.light import Light

WRAP = 1 << 30


def test_before_the_first_command_it_fades_red_in_two_seconds():
    light = Light(0)
    assert light.colour == (0.0, 0.0, 1.0)
    assert light.period_ms == 2000
    assert [light.level(now) for now in (0, 500, 1000, 1500, 1999, 2000)] == [0, 256, 512, 256, 0, 0]


def test_a_glow_is_steady():
    light = Light(0)
    light.glow(1.0, 0.5, 0.0)
    assert light.colour == (1.0, 0.5, 0.0)
    assert light.level(0) == light.level(777) == 512


def test_periods_have_limits():
    light = Light(0)
    for period_s, period_ms in ((0.0, 50), (0.05, 50), (-3.0, 50), (0.1, 100), (1.2345, 1235), (1e9, 3_600_000)):
        light.flash(0.0, 0.0, 0.0, period_s, 0)
        assert light.period_ms == period_ms


def test_it_goes_on_beyond_the_wrap_of_the_ticks():
    light = Light(WRAP - 1250)
    for step in range(100):
        now = (WRAP - 1250 + step * 250) % WRAP
        assert light.level(now) == (0, 128, 256, 384, 512, 384, 256, 128)[step % 8]
