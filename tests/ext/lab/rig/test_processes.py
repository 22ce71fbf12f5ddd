"""Processes end in order and leave nothing behind; a worker's other end answers line by line."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from pebble.extensions.lab.rig.processes import BROKERS, MCUS, OPERATORS, ROBOTS, Processes, Program
from tests.support import until

ON_THREAD = """
from pebble.extensions.lab.rig.worker_end import answer, serve_on_thread
from threading import Event
answered = Event()
def end():
    answer({"ended": True})
    answered.set()
ended = serve_on_thread(lambda line: b'[1]', end)
answered.wait()
assert ended.is_set()
"""


def write_when_ended(name: str, into: Path) -> list[str]:
    """A program that appends its name to a file when it gets SIGTERM."""
    return ["sh", "-c", f"trap 'echo {name} >> {into}; exit' TERM; touch {into}.{name}; while :; do sleep 0.01; done"]


def python(code: str) -> Sequence[str]:
    return [sys.executable, "-c", code]


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


def test_a_worker_on_a_thread_learns_that_its_input_has_closed() -> None:
    with Processes() as processes:
        worker = processes.command("worker", python(ON_THREAD))
        assert worker.ask("", 20) == [1]
        worker.ask_to_end()
        assert worker.answer(20) == {"ended": True}
