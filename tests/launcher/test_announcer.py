"""What the launcher publishes: states and records by its announcer, and lines of its children."""

from __future__ import annotations

import json
import logging
import os
import pty
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from pebble.config import load
from pebble.contract import ESTOP, ESTOP_STATE, codec
from pebble.contract.payloads import EstopCommand, LogRecord
from pebble.launcher import log_forwarding
from pebble.launcher.announcer import Announcer
from pebble.launcher.announcer_pipe import MESSAGE_LIMIT, AnnouncerPipe, next_message
from pebble.launcher.log_forwarding import LevelReader, LogForwarder, OwnRecords, text_of
from pebble.launcher.reactor import Reactor
from pebble.launcher.repeated_stops import REPEAT_S, repeat_stops
from pebble.runtime.output import NonBlockingWriter
from pebble.runtime.parent import Notifier
from pebble.transports import Message, QoS
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.support import WAIT_S, until

WILL = Message("status", b"gone", QoS.DELIVERED, retain=True)


def test_a_failure_to_publish_does_not_end_it_and_what_is_left_in_the_pipe_is_published(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pipe, sent = AnnouncerPipe(Reactor()), list[bytes]()
    descriptor, transport = pipe.connect(WILL), MemoryTransport("announcer", MemoryHub())
    assert next_message(descriptor) == WILL
    with monkeypatch.context() as broken:
        broken.setattr(transport, "publish", lambda *_, **__: 1 // 0)
        thread = threading.Thread(target=Announcer(descriptor, transport).run, args=(Notifier(),))
        thread.start()
        pipe.record(Message("logs", b"1"))
        pipe.state(Message("status", b"2"))
        assert until(lambda: [record.args for record in caplog.records] == [("logs", 1), ("status", 1)])
        broken.setattr(transport, "publish", lambda _topic, payload, **_options: sent.append(payload))
        pipe.record(Message("logs", b"3"))
        pipe.close()
        thread.join(WAIT_S)
    assert sent == [b"3"]
    os.close(descriptor)


class Connection:
    """The pipe, and an announcer that reads when asked."""

    def __init__(self) -> None:
        self.reactor = Reactor()
        self.pipe = AnnouncerPipe(self.reactor)
        self._announcer: int | None = None

    def connect(self) -> None:
        self.hang_up()
        self._announcer = self.pipe.connect(WILL)
        os.set_blocking(self._announcer, False)

    def hang_up(self) -> None:
        if self._announcer is not None:
            os.close(self._announcer)
            self._announcer = None

    def received(self) -> list[bytes]:
        """The payload of every message in the pipe."""
        assert self._announcer is not None
        payloads = []
        with suppress(BlockingIOError):
            while (message := next_message(self._announcer)) is not None:
                payloads.append(message.payload)
        return payloads

    def fill(self) -> int:
        """Records until one is dropped; returns how many there was room for."""
        count = 0
        while not self.pipe.dropped:
            self.pipe.record(Message("logs", b"x" * 500))
            count += 1
        return count - 1

    def close(self) -> None:
        self.pipe.close()
        self.hang_up()
        self.reactor.close()


@pytest.fixture
def connection() -> Iterator[Connection]:
    connection = Connection()
    yield connection
    connection.close()


def test_a_new_announcer_receives_the_will_and_the_present_states_first(connection: Connection) -> None:
    connection.pipe.state(Message("a", b"old"))
    connection.pipe.state(Message("a", b"new"))
    connection.pipe.state(Message("b", b"1"))
    connection.connect()
    connection.pipe.record(Message("logs", b"2"))
    expected = [b"gone", b"new", b"1"]
    assert connection.received() == [*expected, b"2"]
    connection.connect()
    assert connection.received() == expected


def test_records_that_cannot_be_sent_are_counted(connection: Connection) -> None:
    connection.pipe.record(Message("logs", b"early"))
    assert connection.pipe.dropped == 1
    connection.connect()
    connection.hang_up()
    connection.pipe.record(Message("logs", b"the announcer has died"))
    connection.pipe.record(Message("logs", b"x" * MESSAGE_LIMIT))
    assert connection.pipe.dropped == 3


def test_a_state_that_is_too_long_is_logged_once_and_holds_up_no_other(
    connection: Connection, caplog: pytest.LogCaptureFixture
) -> None:
    connection.connect()
    for _ in range(2):
        connection.pipe.state(Message("a", b"x" * MESSAGE_LIMIT))
    connection.pipe.state(Message("b", b"1"))
    connection.pipe.record(Message("logs", b"2"))
    assert connection.received() == [b"gone", b"1", b"2"]
    assert connection.pipe.dropped == 2
    assert caplog.messages == ["a is not published: it has 65604 bytes, and 65536 is the most"]


def test_without_a_bridge_a_stop_is_repeated_until_its_owner_names_it(tmp_path: Path) -> None:
    file, hub, stops = tmp_path / "robot.json", MemoryHub(), list[EstopCommand]()
    line = {"enabled": True, "serial": {"port": "/dev/null"}}
    file.write_text(json.dumps({"robot": {"id": "goob"}, "services": {"serial_mcu_bridge": line}}))
    config, reactor = load(file), Reactor()
    stop, state = ESTOP.topic(config.base), ESTOP_STATE.topic(config.base, owner="serial")
    with MemoryTransport("launcher", hub) as launcher, MemoryTransport("other", hub) as other:
        repeat_stops(config, launcher, reactor)
        other.subscribe(stop, lambda message: stops.append(codec.decode(ESTOP, message.payload)), echo=False)
        other.publish(stop, b"{}", qos=QoS.DELIVERED)
        assert reactor.run_until(lambda: len(stops) > 1, WAIT_S)
        assert {(repeated.stop, repeated.owner) for repeated in stops} == {(stops[0].stop, "serial")}
        fields = {"latched": True, "boot": "00000001", "count": 1, "recent": [stops[0].stop], "by": "", "why": ""}
        fields |= {"since": 0, "persisted": True, "reset_refused": None}
        other.publish(state, json.dumps(fields).encode(), qos=QoS.DELIVERED, retain=True)
        reactor.run_until(lambda: False, REPEAT_S)
        stops.clear()
        reactor.run_until(lambda: False, 2 * REPEAT_S)
        assert stops == []
    reactor.close()


def test_states_are_not_lost_to_a_flood_of_records(connection: Connection) -> None:
    connection.connect()
    assert 50 < connection.fill() < 5000, "the launcher does not wait for an announcer that does not read"
    connection.pipe.state(Message("a", b"old"))
    connection.pipe.state(Message("a", b"new"))
    connection.received()
    received: list[bytes] = []
    assert connection.reactor.run_until(lambda: bool(received.extend(connection.received()) or received), 5)
    assert received == [b"new"]


class Forwarded:
    """A forwarder whose stderr is a pipe."""

    def __init__(self) -> None:
        self.read_end, self.write_end = os.pipe2(os.O_NONBLOCK)
        self.records: list[LogRecord] = []
        self.forwarder = LogForwarder(self.records.append, stderr=self.write_end)

    def written(self) -> str:
        try:
            return os.read(self.read_end, 65536).decode()
        except BlockingIOError:
            return ""

    def close(self) -> None:
        os.close(self.read_end)
        os.close(self.write_end)


@pytest.fixture
def forwarded(monkeypatch: pytest.MonkeyPatch) -> Iterator[Forwarded]:
    monkeypatch.setattr(log_forwarding, "_LEAST", log_forwarding.LEVELS.index("WARNING"))
    made = Forwarded()
    yield made
    made.close()


@pytest.mark.parametrize(
    ("line", "published", "message"),
    [
        ("[ERROR] " + "y" * 2044, True, "[x] " + "y" * 2044),
        ("[ERROR] " + "y" * 2045, True, "[x] " + "y" * 2041 + "..."),
        ("[INFO] routine", True, None),  # below the least level
        ("[ERROR] broken pipe", False, None),  # of the process that publishes
    ],
)
def test_a_childs_line_is_written_and_published_under_its_name(
    forwarded: Forwarded, line: str, published: bool, message: str | None
) -> None:
    forwarded.forwarder.child_line("x", 42, f"12:00:00 {line}", published=published)
    assert line.split()[1] in forwarded.written()
    found = [(record.level, record.service, record.message, record.pid) for record in forwarded.records]
    assert found == ([] if message is None else [("ERROR", "x", message, 42)])
    assert all(record.t > 1_600_000_000_000 and record.logger == "root" for record in forwarded.records)


def test_children_do_not_share_a_traceback(forwarded: Forwarded) -> None:
    forwarded.forwarder.child_line("a", 1, "Traceback (most recent call last):")
    forwarded.forwarder.child_line("b", 2, "fine")
    forwarded.forwarder.child_line("a", 1, "ValueError")
    forwarded.forwarder.child_line("a", 3, "a fresh start")
    assert [(record.service, record.pid) for record in forwarded.records] == [("a", 1), ("a", 1)]


def test_a_tagged_line_is_logged_under_the_name_in_its_tag(forwarded: Forwarded) -> None:
    for line in (
        "[tag-follow 7] 12:00:00 [ERROR] no camera",
        "[tag-follow 7]   at line 3",
        "[tag-follow 8] fine",
        "12:00:00 [WARNING] tag-follow exited with code 3",
        "[no tag] fine",
        "[tag-follow 8]  ",
    ):
        forwarded.forwarder.tagged_line("autonomy_manager", 42, line)
    records = [(record.service, record.pid, record.level, record.message) for record in forwarded.records]
    assert records == [
        ("autonomy_manager:tag-follow", 7, "ERROR", "[autonomy_manager:tag-follow] no camera"),
        ("autonomy_manager:tag-follow", 7, "ERROR", "[autonomy_manager:tag-follow]   at line 3"),
        ("autonomy_manager", 42, "WARNING", "[autonomy_manager] tag-follow exited with code 3"),
    ]
    assert "[INFO] [autonomy_manager:tag-follow] fine" in forwarded.written()


def test_the_launchers_own_records_go_the_same_way(forwarded: Forwarded) -> None:
    log = logging.getLogger("pebble.launcher.process_supervisor")
    with OwnRecords(forwarded.forwarder, "INFO"):
        log.info("quiet")
        log.debug("not even written")
        log.log(35, "between the levels")
        log.warning("it broke", exc_info=ValueError("seven"))
    log.warning("after the end")
    found = [(one.level, one.pid, one.logger, one.message.partition("\n")[0]) for one in forwarded.records]
    expected = [("WARNING", text) for text in ("[launcher] between the levels", "[launcher] it broke")]
    assert found == [(level, os.getpid(), log.name, text) for level, text in expected]
    written = [line.partition(" ")[2] for line in forwarded.written().splitlines()]
    assert written[:2] == ["[INFO] [launcher] quiet", "[WARNING] [launcher] between the levels"]
    assert written[-1] == "[WARNING] [launcher] ValueError: seven"


@pytest.mark.parametrize("opens", [os.pipe, pty.openpty])
def test_writing_never_waits_for_a_reader(opens: Callable[[], tuple[int, int]]) -> None:
    read_end, write_end = opens()  # blocking
    try:
        writer = NonBlockingWriter(write_end)
        for _ in range(1000):
            writer.write("x" * 1000)
        assert writer.dropped > 0
        os.close(read_end)
        dropped = writer.dropped
        writer.write("the reader has gone")
        assert writer.dropped == dropped + 1
    finally:
        os.close(write_end)


@pytest.mark.parametrize(
    ("line", "text"),
    [
        (b"  three  ", "  three"),
        (b"\x1b[2Jgone\x07 \xe2\x80\xae.\r\n", "\\u001b[2Jgone\\u0007 \\u202e."),  # it does not steer a terminal
        (b"a\xff\xfeb", "a\ufffd\ufffdb"),
    ],
)
def test_a_line_becomes_text(line: bytes, text: str) -> None:
    assert text_of(line) == text


@pytest.mark.parametrize(
    ("line", "level", "text"),
    [
        ("12:00:00 [WARN] hello", "WARNING", "hello"),
        ("12:00:00,123 [FATAL] [x] y", "CRITICAL", "[x] y"),
        ("12:00:00 [DEBUG] ", "DEBUG", ""),
        ("12:00:00 [SHOUT] hello", "INFO", "12:00:00 [SHOUT] hello"),
        ("12:00 [ERROR] hello", "INFO", "12:00 [ERROR] hello"),
    ],
)
def test_a_line_of_the_log_format_names_its_level(line: str, level: str, text: str) -> None:
    assert LevelReader().read(line) == (level, text)


#: Lines, and the first letter of the level that each has.
LINES = {
    "a traceback has the level of the line it belongs to": (
        ("12:00:00 [WARNING] it broke", "W"),
        *(("Traceback (most recent call last):", "W"), ("ValueError: no", "W"), ("12:00:01 [INFO] goes on", "I")),
        ("a print", "I"),
    ),
    "one of its own is an error": (
        *(("a print", "I"), ("Traceback (most recent call last):", "E"), ("  File", "E"), ("ImportError: no", "E")),
    ),
    "indented lines continue, and others do not": (
        *(("12:00:00 [ERROR] two reasons:", "E"), ("  one", "E"), ("  two", "E")),
        *(("a print", "I"), ("  of its own", "I")),
    ),
}


@pytest.mark.parametrize("lines", LINES.values(), ids=LINES)
def test_the_levels_of_several_lines(lines: tuple[tuple[str, str], ...]) -> None:
    reader = LevelReader()
    assert [(line, reader.read(line)[0][0]) for line, _ in lines] == [*lines]
