"""The serial line against a real pty: the stop first and last, newest lines, unplugged ports, blocked readers."""

import os
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import pytest

from pebble.errors import DeviceError
from pebble.extensions.lab.simulation.pty import PtyMcu
from pebble.services.serial_mcu_bridge.line.port import Port
from pebble.services.serial_mcu_bridge.line.serial_line import LineState, SerialLine
from pebble.services.serial_mcu_bridge.text.goob_base import STOP, drive_line
from tests.support import SOON_S, cases, until

STOPPED = "M 0.000 0.000"


class Host:
    """A SerialLine, the bytes that it received, its states, and how many chunks it had counted at each."""

    def __init__(self, path: Path, boot_s: float = 0.1, baud: int = 460800) -> None:
        self.received = bytearray()
        self.states: list[LineState] = []
        self.counted: list[int] = []
        self.line = SerialLine(
            str(path),
            baud,
            stop=STOP,
            on_bytes=self.received.extend,
            on_state=self._become,
            boot_s=boot_s,
        )
        self.line.open()

    def _become(self, state: LineState, _problem: str) -> None:
        self.states.append(state)
        self.counted.append(self.line.received)

    def is_ready(self) -> bool:
        return self.line.state is LineState.READY


Connect = Callable[..., Host]


@pytest.fixture
def mcu(tmp_path: Path) -> Iterator[PtyMcu]:
    with PtyMcu("goob", tmp_path / "port") as mcu:
        yield mcu


@pytest.fixture
def connect() -> Iterator[Connect]:
    """Open lines, and close them after the test: the next test's pty may have the same number."""
    with ExitStack() as ends:

        def connect(path: Path, boot_s: float = 0.1, baud: int = 460800) -> Host:
            host = Host(path, boot_s, baud)
            ends.callback(host.line.close)
            return host

        yield connect


@pytest.fixture
def host(mcu: PtyMcu, connect: Connect) -> Host:
    host = connect(mcu.symlink)
    assert until(host.is_ready)
    return host


def traced(mcu: PtyMcu, line: str) -> bool:
    return until(lambda: line in mcu.trace.lines())


def test_the_stop_is_sent_at_open_and_again_after_boot(mcu: PtyMcu, connect: Connect) -> None:
    host = connect(mcu.symlink, boot_s=0.5)
    assert until(host.is_ready)
    assert until(lambda: mcu.trace.lines() == [STOPPED] * 2)
    first, second = (entry.ns for entry in mcu.trace.entries() if entry.event == "line")
    assert second - first >= 0.4e9  # the first one may be read late
    host.line.close()
    host.line.close()
    assert host.states == [LineState.BOOTING, LineState.READY, LineState.CLOSED]
    assert not host.line.drive(drive_line(1, 1))
    SerialLine("/nothing", 115200, stop=STOP, on_bytes=lambda _chunk: None).close()


def test_half_a_line_of_a_killed_host_does_not_damage_the_stop(mcu: PtyMcu, connect: Connect) -> None:
    killed = Port(str(mcu.symlink), 460800)
    killed.write(b"M 0.400 0.")
    assert until(lambda: mcu.host)
    killed.close()
    assert until(lambda: mcu.trace.entries()[-1].event == "closed")  # the MCU has read everything
    connect(mcu.symlink)
    assert until(lambda: len(mcu.trace.lines()) >= 2)
    assert mcu.trace.lines()[:2] == ["M 0.400 0.", STOPPED]


def test_input_from_before_and_during_boot_is_thrown_away(mcu: PtyMcu, connect: Connect) -> None:
    host = connect(mcu.symlink, boot_s=1.0)
    assert until(lambda: mcu.host)
    mcu.reset()
    assert until(host.is_ready)
    assert until(lambda: host.received.count(b"T a0=") > 3)
    assert b"Done!" not in host.received


@pytest.mark.parametrize(("boot_s", "sent"), [(0.3, "M 0.500 0.500"), (0.9, STOPPED)])
def test_a_command_waits_for_the_boot_and_one_too_old_then_is_a_stop(
    mcu: PtyMcu, connect: Connect, boot_s: float, sent: str
) -> None:
    host = connect(mcu.symlink, boot_s=boot_s)
    assert until(lambda: host.line.drive(drive_line(0.5, 0.5)))
    assert until(host.is_ready)
    assert until(lambda: len(mcu.trace.lines()) == 3)
    assert mcu.trace.lines() == [STOPPED, STOPPED, sent]


def rests(mcu: PtyMcu) -> bool:
    return [entry.motors for entry in mcu.trace.entries() if entry.motors is not None][-1] == (0.0, 0.0)


def test_of_a_burst_the_last_command_is_sent_and_few_before_it(mcu: PtyMcu, host: Host) -> None:
    for number in range(1000):
        host.line.drive(drive_line(number / 1000, 0.5))
    assert traced(mcu, "M 0.999 0.500")
    sent = [line for line in mcu.trace.lines() if line.endswith(" 0.500")]
    assert sent[-1] == "M 0.999 0.500"
    assert sent == sorted(sent)
    assert len(sent) < 500
    for number in range(500):
        host.line.drive(drive_line(number / 1000, 1.0))
    host.line.halt()
    assert until(lambda: mcu.trace.lines()[-1] == STOPPED and rests(mcu)), "it ends in a stop"


def test_the_stop_is_the_last_line_even_while_others_still_drive(mcu: PtyMcu, connect: Connect) -> None:
    for round_ in range(1, cases(3, 20) + 1):
        host = connect(mcu.symlink, boot_s=0.0, baud=4_000_000)
        assert until(host.is_ready, step=0.0005)

        def refused(line: SerialLine = host.line) -> bool:
            return not line.drive(drive_line(0.5, 1.0))

        driver = threading.Thread(target=lambda refused=refused: until(refused, step=0.0))
        driver.start()
        assert until(lambda n=round_: mcu.trace.lines().count("M 0.500 1.000") >= 20 * n)  # type: ignore[misc]
        host.line.close()
        driver.join(10)
        assert not driver.is_alive()
        assert until(lambda n=round_: [entry.event for entry in mcu.trace.entries()].count("closed") == n)  # type: ignore[misc]
        assert mcu.trace.lines()[-1] == STOPPED


def test_after_a_replug_the_first_line_is_the_stop(mcu: PtyMcu, host: Host, caplog: pytest.LogCaptureFixture) -> None:
    host.line.drive(drive_line(0.7, 0.7))
    assert traced(mcu, "M 0.700 0.700")
    assert until(lambda: host.line.received)
    mcu.unplug()
    assert until(lambda: host.line.state is LineState.ABSENT)
    assert "gone" in host.line.problem
    assert not host.line.drive(drive_line(0.8, 0.8))
    assert not host.line.halt()
    mcu.replug()
    assert until(host.is_ready)
    assert host.line.problem == ""
    assert "gone" in caplog.text
    assert until(lambda: host.line.drive(drive_line(0.9, 0.9)))
    assert traced(mcu, "M 0.900 0.900")
    entries = mcu.trace.entries()
    replug = max(index for index, entry in enumerate(entries) if entry.event == "plugged")
    assert [entry.line for entry in entries[replug:] if entry.event == "line"] == [STOPPED, STOPPED, "M 0.900 0.900"]
    assert host.line.opened == 2
    counted = dict(zip(host.states, host.counted, strict=True))  # of each state, the newest
    assert (counted[LineState.ABSENT] > 0, counted[LineState.READY]) == (True, 0), "since it was opened"


def test_a_path_that_leads_to_another_device_is_followed(tmp_path: Path, connect: Connect) -> None:
    with PtyMcu("goob", tmp_path / "old") as old, PtyMcu("goob", tmp_path / "new") as new:
        link = tmp_path / "by-id"
        link.symlink_to(old.symlink.readlink())
        host = connect(link)
        assert until(host.is_ready)
        again = tmp_path / "again"
        again.symlink_to(new.symlink.readlink())
        again.replace(link)
        assert until(lambda: new.trace.lines() == [STOPPED] * 2)


def test_a_port_that_comes_late_is_found_and_one_in_use_refused_until_it_is_free(mcu: PtyMcu, connect: Connect) -> None:
    mcu.unplug()
    host = connect(mcu.symlink)
    assert until(lambda: host.line.state is LineState.ABSENT)
    assert "No such file" in host.line.problem
    mcu.replug()
    assert until(host.is_ready)
    host.line.close()
    other = Port(str(mcu.symlink), 460800)
    host = connect(mcu.symlink)
    assert until(lambda: "another program has it open" in host.line.problem)
    other.close()
    assert until(host.is_ready)


def test_what_is_no_serial_port_is_a_device_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path / "file", tmp_path / "nothing"):
        with pytest.raises(DeviceError, match=str(path)):
            Port(str(path), 115200)


class StuckDevice:
    """A pty whose other side reads only on request. Of 16 KB in the kernel, a flush cannot remove 4 KB."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        self.path = Path(os.ttyname(slave))
        self._slave = slave
        self._seen = bytearray()

    def seen(self) -> bytes:
        """Read the available bytes, and return everything read so far."""
        with suppress(BlockingIOError):
            while chunk := os.read(self.master, 65_536):
                self._seen += chunk
        return bytes(self._seen)

    def close(self) -> None:
        os.close(self.master)
        os.close(self._slave)


def fill(host: Host) -> float:
    """Send drive lines until the kernel's buffer is full; return the duration of the longest call in seconds."""
    longest = 0.0
    while until(lambda: not host.line.output.outbox.waiting, 0.2, step=0.0002):
        before = time.monotonic()
        host.line.drive(drive_line(0.3, 0.3))
        longest = max(longest, time.monotonic() - before)
    return longest


def test_old_commands_of_a_killed_host_are_thrown_away(connect: Connect) -> None:
    with closing(StuckDevice()) as stuck:
        killed = Port(str(stuck.path), 460800)
        assert killed.write(drive_line(0.3, 0.3) * 600) == 8400
        killed.close()
        assert until(connect(stuck.path, boot_s=0.05).is_ready)
        assert until(lambda: stuck.seen().endswith(b"\n" + STOP + STOP))
        assert len(stuck.seen()) < 5000


def test_a_stuck_reader_does_not_block_and_finds_no_old_commands_later_and_the_stop_at_the_end(
    connect: Connect,
) -> None:
    with closing(StuckDevice()) as stuck:
        host = connect(stuck.path, boot_s=0.05)
        assert until(host.is_ready)
        assert fill(host) < SOON_S
        assert until(lambda: LineState.ABSENT in host.states, step=0.001)
        assert len(stuck.seen()) < 5000
        assert until(lambda: host.states.count(LineState.READY) == 2)
        assert until(lambda: stuck.seen().endswith(b"\n" + STOP + STOP))
        assert len(stuck.seen()) < 5000
        host.line.drive(drive_line(0.4, 0.4))
        assert until(lambda: stuck.seen().endswith(STOP + drive_line(0.4, 0.4)))
        count = len(stuck.seen())
        fill(host)
        before = time.monotonic()
        host.line.close()
        assert time.monotonic() - before < 2.0
        assert host.line.state is LineState.CLOSED
        assert stuck.seen().endswith(b"\n" + STOP)
        assert len(stuck.seen()) < count + 5000
