from __future__ import annotations

import logging
import os
from collections.abc import Iterator

import pytest

from pebble.config.tree import LogsSection
from pebble.launcher.log_forwarding import Echo, LogForwarder, OwnRecords
from pebble.payloads import LogRecord


class Forwarded:
    """A forwarder whose echo is a pipe."""

    def __init__(self, logs: LogsSection) -> None:
        self.read_end, self.write_end = os.pipe2(os.O_NONBLOCK)
        self.records: list[LogRecord] = []
        self.forwarder = LogForwarder(self.records.append, logs, echo=self.write_end)

    def echoed(self) -> str:
        try:
            return os.read(self.read_end, 65536).decode()
        except BlockingIOError:
            return ""

    def close(self) -> None:
        os.close(self.read_end)
        os.close(self.write_end)


@pytest.fixture
def forwarded() -> Iterator[Forwarded]:
    made = Forwarded(LogsSection(min_level="WARNING", max_message_chars=64))
    yield made
    made.close()


def test_a_childs_line_is_echoed_and_published_under_its_name(forwarded: Forwarded) -> None:
    forwarded.forwarder.child_line("mqtt_bridge", 42, "12:00:00 [ERROR] far away")
    (record,) = forwarded.records
    assert (record.level, record.service, record.message) == ("ERROR", "mqtt_bridge", "[mqtt_bridge] far away")
    assert (record.pid, record.logger) == (42, "root")
    assert record.t > 1_600_000_000_000
    assert forwarded.echoed().endswith("[ERROR] [mqtt_bridge] far away\n")


def test_what_is_below_the_least_level_stays_here(forwarded: Forwarded) -> None:
    forwarded.forwarder.child_line("mqtt_bridge", 42, "12:00:00 [INFO] routine")
    assert forwarded.records == []
    assert "routine" in forwarded.echoed()


def test_a_message_is_cut_with_its_name_counted(forwarded: Forwarded) -> None:
    forwarded.forwarder.child_line("x", 1, "12:00:00 [ERROR] " + "y" * 1000)
    assert forwarded.records[0].message == "[x] " + "y" * 57 + "..."


def test_children_do_not_share_a_traceback(forwarded: Forwarded) -> None:
    forwarded.forwarder.child_line("a", 1, "Traceback (most recent call last):")
    forwarded.forwarder.child_line("b", 2, "fine")
    forwarded.forwarder.child_line("a", 1, "ValueError")
    forwarded.forwarder.child_started("a")
    forwarded.forwarder.child_line("a", 3, "a fresh start")
    assert [(record.service, record.pid) for record in forwarded.records] == [("a", 1), ("a", 1)]


def test_the_launchers_own_records_go_the_same_way(forwarded: Forwarded) -> None:
    log = logging.getLogger("pebble.launcher.keeper")
    with OwnRecords(forwarded.forwarder, "INFO"):
        log.warning("child %s ended", "x")
        log.info("quiet")
        log.debug("not even echoed")
        log.log(35, "between the levels")
    log.warning("after the end")
    assert [(record.level, record.message) for record in forwarded.records] == [
        ("WARNING", "[launcher] child x ended"),
        ("WARNING", "[launcher] between the levels"),
    ]
    assert (forwarded.records[0].pid, forwarded.records[0].logger) == (os.getpid(), "pebble.launcher.keeper")
    echoed = forwarded.echoed()
    assert "[INFO] [launcher] quiet" in echoed
    assert "not even" not in echoed
    assert "after the end" not in echoed


def test_an_exception_is_one_record_and_several_lines(forwarded: Forwarded) -> None:
    try:
        raise ValueError("seven")
    except ValueError:
        with OwnRecords(forwarded.forwarder, "INFO"):
            logging.getLogger("pebble.launcher.keeper").exception("it broke")
    assert len(forwarded.records) == 1
    assert "[ERROR] [launcher] ValueError: seven" in forwarded.echoed()


def test_what_publishing_itself_causes_is_not_published(forwarded: Forwarded) -> None:
    forwarded.forwarder.child_line("announcer", 42, "12:00:00 [ERROR] broken pipe", published=False)
    assert forwarded.records == []
    assert "broken pipe" in forwarded.echoed()


def test_an_echo_nobody_reads_stops_nothing() -> None:
    read_end, write_end = os.pipe()  # blocking, as a terminal is
    try:
        echo = Echo(write_end)
        for _ in range(1000):
            echo.write("x" * 1000)
        assert echo.dropped > 0
        os.close(read_end)
        dropped = echo.dropped
        echo.write("nobody is there any more")
        assert echo.dropped == dropped + 1
    finally:
        os.close(write_end)
