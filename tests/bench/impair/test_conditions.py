"""The conditions are the paper's, and their schedules are the same each time."""

import pytest

from pebble.bench.impair.conditions import CONDITIONS, Handover, Shape, arrival

NAMES = [
    *("base-start", "1024k", "512k", "256k", "128k", "64k", "1%", "2%", "5%", "10%"),
    *("256k+1%", "128k+2%", "64k+5%", "base-end", "starlink", "wifi-power-save"),
]
SATELLITE = Shape(delay_ms=25, handover=Handover(15, first_s=5, gap_ms=100, extra_ms=40, recovery_s=1))


def test_the_trials_are_the_papers_and_two_profiles() -> None:
    assert [condition.name for condition in CONDITIONS] == NAMES


def test_names_match_their_shapes() -> None:
    shapes = {condition.name: condition.up for condition in CONDITIONS}
    assert shapes["base-start"] == shapes["base-end"] == Shape()
    assert shapes["512k"] == Shape(kbit=512)
    assert shapes["10%"] == Shape(loss=0.1)
    assert shapes["64k+5%"] == Shape(kbit=64, loss=0.05)


def test_only_the_uplink_is_shaped_but_in_the_profiles() -> None:
    assert {condition.down for condition in CONDITIONS[:14]} == {Shape()}
    assert all(condition.up.timed and condition.down.timed for condition in CONDITIONS[14:])
    assert not any(condition.up.timed for condition in CONDITIONS[:14])


def test_without_delay_everything_arrives_as_it_is_sent() -> None:
    assert arrival(Shape(), "up", 1.5) == 1.5


def test_jitter_stays_in_its_band_and_is_the_same_for_the_same_seed() -> None:
    shape, times = Shape(delay_ms=20, jitter_ms=5), [n * 0.013 for n in range(500)]
    one, same, other = ([arrival(shape, seed, t) for t in times] for seed in ("up", "up", "down"))
    delays = [at - sent for at, sent in zip(one, times, strict=True) if at is not None]
    assert len(delays) == 500
    assert 0.015 - 1e-9 <= min(delays) < 0.016
    assert 0.024 < max(delays) <= 0.025 + 1e-9
    assert one == same != other


@pytest.mark.parametrize("handover", [5.0, 20.0, 35.0])
def test_a_handover_is_a_gap_and_then_a_longer_way_for_a_while(handover: float) -> None:
    assert arrival(SATELLITE, "up", handover + 0.05) is None
    times = [handover - 0.01, handover + 0.1001, handover + 0.6, handover + 1.2]
    delays_ms = [((arrival(SATELLITE, "up", sent) or 0) - sent) * 1000 for sent in times]
    assert delays_ms == pytest.approx([25, 65, 45, 25], abs=0.1)


def test_no_handover_before_the_first() -> None:
    assert arrival(SATELLITE, "up", 0.0) == pytest.approx(0.025)


def test_power_save_holds_everything_until_a_beacon() -> None:
    shape = Shape(delay_ms=2, beacon_ms=100)
    arrivals = [arrival(shape, "down", sent) for sent in (0.001, 0.05, 0.097, 0.099, 0.15)]
    assert arrivals == pytest.approx([0.1, 0.1, 0.1, 0.2, 0.2])
