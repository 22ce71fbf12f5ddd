"""The bridge comparison without robots: matching of commands and reports, cells, turns."""

from pebble.extensions.lab.bench.bridge import COMMANDS, UNLOADED, cells_of
from pebble.extensions.lab.bench.bridge_operator import (
    SERVICES,
    Arrived,
    Turn,
    arrivals,
    matched,
)
from pebble.extensions.lab.simulation.trace import Entry
from pebble.services.serial_mcu_bridge.text.goob_base import Touch

MS = 1_000_000
FORWARDER, SERIAL = PARTS = tuple(SERVICES)


def test_a_command_counts_once_and_when_it_came_first() -> None:
    turn = Turn(0, 200 * MS, {(0.1, 0.1): 10 * MS, (0.2, 0.1): 60 * MS, (0.3, 0.1): 110 * MS}, {FORWARDER: 0.002})
    trace = [
        Entry(11 * MS, "line", "M 0.100 0.100"),
        Entry(13 * MS, "line", "M 0.100 0.100"),
        Entry(62 * MS, "line", "M 0.200 0.100"),
        Entry(63 * MS, "motors", "0.200 0.100"),
        Entry(900 * MS, "line", "M 0.000 0.000"),
    ]
    down, forwarded = cells_of("mqtt", COMMANDS, turn, Arrived(arrivals(trace), [], []))
    assert (down.samples, down.lost) == ([1.0, 2.0], 1)
    assert forwarded.samples == [1000.0]  # us for each of two


def test_a_report_is_identified_by_values_that_occur_once() -> None:
    turn = Turn(100 * MS, 200 * MS, {}, {FORWARDER: 0.003})
    trace = [
        Entry(90 * MS, "said", "T a0=1 a1=1 a2=1"),
        Entry(110 * MS, "said", "T a0=2 a1=2 a2=2"),
        Entry(115 * MS, "said", "OK M"),
        Entry(120 * MS, "line", "T a0=7 a1=7 a2=7"),
        Entry(130 * MS, "said", "T a0=3 a1=3 a2=3"),
        Entry(150 * MS, "said", "T a0=4 a1=4 a2=4"),
        Entry(170 * MS, "said", "T a0=3 a1=3 a2=3"),
        Entry(190 * MS, "said", "T a0=5 a1=5 a2=5"),
        Entry(210 * MS, "said", "T a0=6 a1=6 a2=6"),
    ]
    received = [
        (ns * MS, Touch(value, value, value)) for ns, value in ((91, 1), (112, 2), (131, 3), (193, 5), (211, 6))
    ]
    _, up, forwarded = cells_of("mqtt", UNLOADED, turn, Arrived({}, matched(trace, received), received))
    assert (up.samples, up.total("sent")) == ([2.0, 3.0], 3)
    assert forwarded.samples == [1000.0]  # us for each of the three that were received meanwhile
