"""What a motor owner keeps: the newest commands, the file that survives a power cut, Hall samples for the original."""

from __future__ import annotations

import json
import os
import signal
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from pebble.config import Security
from pebble.contract.payloads import ControlRequest, ControlTurn, ControlVouched, Drive, EstopCommand, EstopReset
from pebble.motors.control import Control
from pebble.motors.motion_inbox import MotionInbox
from pebble.motors.state_file import StateFile, Unreadable
from pebble.services.serial_mcu_bridge.text.hall_memory import HallMemory
from pebble.transports import State
from tests.kit.hall_reader import HallReader
from tests.support import WAIT_S, until


class Saved:
    """A file, and the results of its writes."""

    def __init__(self, path: Path) -> None:
        self.results: list[tuple[int, bool]] = []
        self.file = StateFile(path, lambda number, succeeded: self.results.append((number, succeeded)))


def test_what_was_saved_is_there_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "estop.json"
    saved = Saved(path)
    assert saved.file.can_save()
    assert saved.file.load() is None
    number = saved.file.save({"latched": True})
    assert until(lambda: saved.results == [(number, True)])
    assert Saved(path).file.load() == {"latched": True}
    assert [file.name for file in path.parent.iterdir()] == ["estop.json"]
    assert path.parent.stat().st_mode & 0o77 == 0


def test_only_the_newest_of_many_values_is_written_and_closing_waits_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved, may_write = Saved(tmp_path / "estop.json"), threading.Event()
    dumps, written = json.dumps, []

    def slowly(value: Any) -> str:
        assert may_write.wait(WAIT_S)
        written.append(value)
        return dumps(value)

    monkeypatch.setattr(json, "dumps", slowly)
    for value in range(100):
        saved.file.save(value)
    threading.Timer(0.1, may_write.set).start()
    saved.file.close()
    assert written[-1] == saved.file.load() == 99
    assert len(written) <= 2
    assert saved.results[-1] == (100, True)
    Saved(tmp_path / "estop.json").file.close()  # nothing was saved: there is no thread
    below = Saved(tmp_path / "estop.json" / "robot" / "estop.json")
    assert not below.file.can_save(), "a place below a file cannot be written"
    assert below.file.load() is None or isinstance(below.file.load(), Unreadable)


@pytest.mark.parametrize("content", [b"{", b"\xff", b"[" * 10_000, b"null", b'"' + b"x" * 20_000 + b'"', None])
def test_a_damaged_file_differs_from_none(tmp_path: Path, content: bytes | None) -> None:
    """A folder in its place is one, too, and a failed write."""
    path = tmp_path / "estop.json"
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)
    saved = Saved(path)
    assert isinstance(saved.file.load(), Unreadable)
    number = saved.file.save({})
    assert until(lambda: saved.results == [(number, content is not None)])


@pytest.mark.timeout(10)
@pytest.mark.parametrize("place", [os.mkfifo, lambda path: path.symlink_to(path.with_name("other"))])
def test_a_fifo_in_its_place_is_a_damaged_file_and_a_link_is_not_followed(
    tmp_path: Path, place: Callable[[Path], object]
) -> None:
    path, other = tmp_path / "estop.json", tmp_path / "other"
    other.write_text("kept")
    os.mkfifo(path)
    place(tmp_path / ".estop.json.new")
    saved = Saved(path)
    assert isinstance(saved.file.load(), Unreadable)
    saved.file.save({"latched": True})
    saved.file.close()
    assert (other.read_text(), Saved(path).file.load()) == ("kept", {"latched": True})


def test_a_folder_that_cannot_be_looked_into_does_not_end_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stat = Path.stat

    def refuse(path: Path, **options: Any) -> os.stat_result:
        if "closed" in path.parts:  # as for other users than root
            raise PermissionError
        return stat(path, **options)

    monkeypatch.setattr(Path, "stat", refuse)
    assert Saved(tmp_path / "closed" / "state" / "estop.json").file.can_save()  # root may make it


# -- the inbox before the motors: the newest command and request of each sender, and every zero


ANN, OTTO = ControlRequest(id="aaaaaaaa", by="ann", for_ms=10_000), ControlRequest(id="00000001", by="otto")
RELEASE = ControlRequest(id="aaaaaaaa", by="ann", want="release")


def control() -> Control:
    """Return that of an owner: ann has control, and otto asks for it."""
    made = Control(Security(), lambda _state: None, 0.0)
    for request in (ANN, OTTO):
        made.request(request, over=False, now=0.0)
    return made


def empty() -> MotionInbox:
    return MotionInbox(control())


def script(run: int, z: float = 0.5) -> Drive:
    return Drive(z=z, source="autonomy", run=run)


def drives(inbox: MotionInbox) -> list[Drive]:
    return [received.drive for received in inbox.take().drives]


ZERO, FINAL, JOY = Drive(), Drive(valid_ms=0), Drive(x=1, source="joystick")
#: Drive commands in the order of their arrival, and what waits then.
WAITING = {
    "only the newest of a person": ([Drive(z=number / 10) for number in range(1, 11)], [Drive(z=1.0)]),
    "a zero before what replaces it": ([Drive(z=1), ZERO, Drive(z=0.5), Drive(z=0.25)], [ZERO, Drive(z=0.25)]),
    "several zeros as one that still bars": ([FINAL, Drive(z=1), ZERO, Drive(z=0.5)], [FINAL, Drive(z=0.5)]),
    "the same in the other order": ([ZERO, Drive(z=1), FINAL, Drive(z=0.5)], [FINAL, Drive(z=0.5)]),
    "a person and each run have their place": (
        [script(1), Drive(z=1), script(2), script(1, 0.0), JOY], [script(2), script(1, 0.0), JOY],
    ),
}  # fmt: skip


@pytest.mark.parametrize(("arrived", "waiting"), WAITING.values(), ids=WAITING)
def test_what_waits(arrived: list[Drive], waiting: list[Drive]) -> None:
    inbox = empty()
    for drive in arrived:
        inbox.put_drive(drive, 0.0)
    assert drives(inbox) == waiting
    assert drives(inbox) == []


def test_any_number_of_runs_never_displaces_the_person() -> None:
    inbox = empty()
    inbox.put_drive(Drive(), 0.0)
    for run in range(1, 1000):
        inbox.put_drive(script(run), 0.0)
    waiting = drives(inbox)
    assert waiting[0] == Drive()
    assert waiting[1:] == [script(run) for run in range(993, 1000)]
    assert inbox.dropped == 999 - 7


def test_stops_have_one_place_per_name_and_are_bounded_and_so_are_resets() -> None:
    inbox, names = empty(), [f"{number:016x}" for number in range(20)]
    assert inbox.put_drive(Drive(), 0.0)
    for name in names:
        assert not inbox.put_stop(EstopCommand(stop=name))
        assert not inbox.put_stop(EstopCommand(stop=name))
        assert not inbox.put_reset(EstopReset(boot="a", count=1), 0.0)
    batch = inbox.take()
    assert [stop.stop for stop in batch.stops] == names[-8:]
    assert (len(batch.resets), len(batch.drives)) == (8, 1)
    assert inbox.put_stop(EstopCommand()), "the first after a take is marked"


def test_strangers_displace_nothing_of_who_has_control_or_asks_for_it() -> None:
    owner = control()
    inbox, held = MotionInbox(owner), Drive(z=1, key=owner.lease.key)
    inbox.put_drive(Drive(key=owner.lease.key), 0.0)
    for request in (ANN, OTTO):
        inbox.put_request(request, False, 0.0)
    inbox.put_drive(held, 0.0)
    for number in range(1000):
        inbox.put_drive(Drive(z=-1), 0.0)
        inbox.put_drive(Drive(z=-1, key=f"{number:08x}"), 0.0)
        inbox.put_drive(script(number + 1), 0.0)
        inbox.put_request(ControlRequest(id=f"f{number:07x}"), number % 2 == 0, 0.0)
    batch = inbox.take()
    assert [received.drive for received in batch.drives][:2] == [Drive(key=owner.lease.key), held]
    assert [received.drive for received in batch.drives if not received.drive.signed][2:] == [
        Drive(z=-1, key="000003e7")
    ]
    assert [received.request for received in batch.requests][:2] == [ANN, OTTO]
    assert len(batch.requests) == 8


def test_an_account_with_many_persons_has_one_place_for_each_id() -> None:
    owner = Control(Security(level="named"), lambda _state: None, 0.0)
    inbox = MotionInbox(owner)
    owner.request(ANN, over=False, now=0.0)
    owner.request(ControlRequest(id="00000001", by="otto/0"), over=False, now=0.0)
    inbox.put_request(ANN, False, 0.0)
    for person in range(20):
        inbox.put_request(ControlRequest(id="00000001", by=f"otto/{person}"), False, 0.0)
    assert [one.request.by for one in inbox.take().requests] == ["ann", "otto/19"]


#: What one client sends, and what waits then: whether it is a release, and whether it takes control over.
REQUESTS = {
    "the newest": ([(ANN, False), (ANN, False)], [(False, False)]),
    "a take that is repeated as a request": ([(ANN, True), (ANN, False)], [(False, True)]),
    "a release after it": ([(ANN, True), (RELEASE, False)], [(True, False)]),
    "a request after a release": ([(RELEASE, False), (ANN, False)], [(False, False)]),
    "no release takes over": ([(RELEASE, True)], [(True, False)]),
}


@pytest.mark.parametrize(("arrived", "waiting"), REQUESTS.values(), ids=REQUESTS)
def test_which_request_waits(arrived: list[tuple[ControlRequest, bool]], waiting: list[tuple[bool, bool]]) -> None:
    inbox = empty()
    for request, over in arrived:
        inbox.put_request(request, over, 0.0)
    assert [(one.request.ends(), one.over) for one in inbox.take().requests] == waiting


def test_the_newest_turn_of_each_owner_and_the_newest_vouched_time_wait_and_are_taken_once() -> None:
    inbox, vouched = empty(), ControlVouched(begin=1, end=3)
    arm, tail = ControlTurn(boot="b", turn=2), ControlTurn(boot="b", turn=1)
    assert inbox.put_turn("arm", ControlTurn(boot="b", turn=1))
    assert not inbox.put_turn("tail", tail)
    assert not inbox.put_turn("arm", arm)
    assert not inbox.put_vouched(ControlVouched(begin=1, end=2))
    assert not inbox.put_vouched(vouched)
    assert not inbox.put_drive(ZERO, 0.0)
    batch = inbox.take()
    assert (sorted(batch.turns, key=str), batch.vouched) == ([("arm", arm), ("tail", tail)], vouched)
    batch = inbox.take()
    assert (batch.turns, batch.vouched) == ([], None)
    assert inbox.put_vouched(vouched)
    assert not inbox.put_turn("arm", arm)


@pytest.mark.parametrize(("states", "lost"), [((State.CONNECTED,), False), ((State.CONNECTING, State.CONNECTED), True)])
def test_a_connection_that_was_lost_is_known_once(states: tuple[State, ...], lost: bool) -> None:
    inbox = empty()
    for state in states:
        inbox.note_state(state)
    assert inbox.put_drive(ZERO, 0.0)  # which itself is nothing to wake up for
    assert [inbox.take().lost for _ in range(2)] == [lost, False]


# -- Hall samples in the shared memory where the original's wheel-odometry looks for them


SLOTS = 64
SECOND = 1_000_000_000


@pytest.fixture
def path() -> Iterator[Path]:
    """Where there is nothing yet."""
    path = Path("/dev/shm") / f"pebble-test-{os.getpid()}-{time.monotonic_ns()}"
    yield path
    path.unlink(missing_ok=True)


@pytest.fixture
def memory(path: Path) -> Iterator[HallMemory]:
    memory = HallMemory(path.name, SLOTS)
    yield memory
    memory.close()


def fill(memory: HallMemory, count: int, at_ns: int = SECOND) -> None:
    for number in range(count):
        memory.write(at_ns + number, (number, -1, 2), None)


@contextmanager
def always_written(memory: HallMemory) -> Iterator[None]:
    """Another process writes samples as fast as it can."""
    child = os.fork()
    while child == 0:
        fill(memory, 1000)
    yield
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)


def test_every_byte_is_where_the_original_has_it(path: Path, memory: HallMemory) -> None:
    assert not path.exists(), "before the first sample"
    memory.write(5, (512, -498, 7), True)
    memory.write(6, (1, 2, 3), False)
    memory.write(7, (4, 5, 6), None)
    raw = path.read_bytes()
    assert len(raw) == 24 + 32 * SLOTS
    assert raw[:24] == b"PBODRAW1" + struct.pack("<HHIQ", 1, SLOTS, 0, 3)
    rows = [(1, 5, 512, -498, 7, 1), (2, 6, 1, 2, 3, 0), (3, 7, 4, 5, 6, -1)]
    assert raw[24:].rstrip(b"\0") == b"".join(struct.pack("<QQiiii", *row) for row in rows)
    assert path.stat().st_mode & 0o777 == 0o600


def test_the_newest_number_never_goes_back(path: Path, memory: HallMemory) -> None:
    """A reader on another processor that saw a 0 in between would take all samples once more."""
    fill(memory, 1)
    reader, seen = HallReader(path.name), [0]
    with always_written(memory):
        while len(set(seen)) < 1000:
            seen += [reader.newest for _ in range(5000)]
    assert seen == sorted(seen)


def test_numbers_go_on_where_the_last_writer_ended_and_a_removed_one_is_made_again_within_a_second(
    path: Path, memory: HallMemory
) -> None:
    fill(memory, 100)
    reader = HallReader(path.name)
    memory.close()
    assert path.exists(), "readers wait for the next one"
    again = HallMemory(f"/{path.name}", SLOTS)
    fill(again, 5)
    assert [sample.number for sample in reader.read()] == [101, 102, 103, 104, 105]
    path.unlink()
    again.write(2 * SECOND, (1, 2, 3), None)
    assert HallReader(path.name).newest == 106
    again.close()


def second_writer(path: Path) -> object:
    other = HallMemory(path.name, SLOTS)
    other.write(1, (1, 1, 1), None)
    return other


REFUSED: dict[str, tuple[Callable[[Path], object], str]] = {
    "another size": (lambda path: path.write_bytes(bytes(100)), "has 100 bytes, and 64 slots need 2072"),
    "another writer": (second_writer, "is written by another process"),
    "a link": (lambda path: path.symlink_to("/etc/passwd"), "Too many levels of symbolic links"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_not_its_own_stays_as_it_is(
    path: Path, memory: HallMemory, what: str, caplog: pytest.LogCaptureFixture
) -> None:
    prepare, text = REFUSED[what]
    _open = prepare(path)
    before = path.read_bytes()
    for second in range(1, 4):
        fill(memory, 3, second * SECOND)
    assert path.read_bytes() == before
    assert [record.message.partition(f"{path} ")[2][: len(text)] for record in caplog.records] == [text], "once"
