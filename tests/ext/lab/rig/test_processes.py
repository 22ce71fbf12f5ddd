"""Processes end in order and leave nothing behind."""

from __future__ import annotations

from pathlib import Path

from pebble.extensions.lab.rig.processes import BROKERS, MCUS, OPERATORS, ROBOTS, Processes, Program
from tests.support import until


def write_when_ended(name: str, into: Path) -> list[str]:
    """A program that appends its name to a file when it gets SIGTERM."""
    return ["sh", "-c", f"trap 'echo {name} >> {into}; exit' TERM; touch {into}.{name}; while :; do sleep 0.01; done"]


def test_operators_end_first_and_brokers_last(tmp_path: Path) -> None:
    order = tmp_path / "order"
    with Processes() as processes:
        for name, kind in (("broker", BROKERS), ("mcu", MCUS), ("robot", ROBOTS), ("operator", OPERATORS)):
            processes.add(Program(name, write_when_ended(name, order), tmp_path / f"{name}.log"), kind)
            assert until(Path(f"{order}.{name}").exists)
        assert processes.unexpected_exits() == []
    assert order.read_text().split() == ["operator", "robot", "mcu", "broker"]
    assert not processes.folder.exists()


def test_one_that_ended_by_itself_is_named_and_one_that_was_ended_is_not(tmp_path: Path) -> None:
    with Processes() as processes:
        ended = processes.add(Program("the hub", ["true"], tmp_path / "hub.log"), BROKERS)
        assert until(lambda: ended.ended)
        assert processes.unexpected_exits() == [f"the hub ended unexpectedly: see {ended.log}"]
        processes.end(ended)
        assert processes.unexpected_exits() == []
