"""Results of two robots in words: what is claimed, and what is not."""

from pebble.bench.results import Cell
from pebble.bench.tables import caveat, sentence, spread


def cells(mqtt: list[float], zenoh: list[float]) -> list[Cell]:
    return [
        Cell(variant=kind, measure="m", unit="ms", rounds=[[figure] for figure in figures])
        for kind, figures in (("mqtt", mqtt), ("zenoh", zenoh))
    ]


def printed(mqtt: list[float], zenoh: list[float]) -> str:
    return sentence("M", cells(mqtt, zenoh), quantity="time")


def test_a_spread_is_the_median_and_both_ends() -> None:
    assert spread(cells([3.0, 1.0, 2.0], [])[0]) == "2.00 (1.00 to 3.00)"
    assert spread(cells([3.0], [])[0]) == "3.00"
    assert spread(cells([], [])[0]) == "–"


def test_enough_rounds_give_an_interval() -> None:
    pair = cells([10.0 + n / 100 for n in range(8)], [20.0 + n / 100 for n in range(8)])
    assert sentence("M", pair, quantity="time").startswith("M: zenoh takes 2.00× the time of mqtt (99 % interval ")
    assert caveat(pair) == []


def test_what_differs_by_chance_is_equal() -> None:
    noisy = [10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 16.0, 17.0]
    assert "equal within noise" in printed(noisy, noisy[::-1])


def test_few_rounds_give_no_interval_and_a_note() -> None:
    low, high = [1.0, 2.0, 3.0, 4.0, 5.0], [6.0, 7.0, 8.0, 9.0, 10.0]
    assert printed(low, high) == "M: mqtt 3.00 (1.00 to 5.00) ms, zenoh 8.00 (6.00 to 10.0) ms"
    pair = cells([1.0, 2.0], [2.0, 4.0])
    (line,) = caveat(pair)
    assert line.startswith("2 rounds, and a 99 % interval needs 8")


def test_one_round_claims_nothing() -> None:
    assert printed([1.0], [2.0]) == "M: mqtt 1.00 ms, zenoh 2.00 ms"
    assert caveat(cells([1.0], [2.0]))[0].startswith("1 round, and ")


def test_a_single_robot_is_not_compared() -> None:
    assert sentence("M", cells([1.0, 2.0], [])[:1], quantity="time") == "M: mqtt 1.50 (1.00 to 2.00) ms"
