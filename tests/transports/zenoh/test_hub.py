"""Who is alive in a run directory; what the hub remembers, also on disk; when a will is due; questions to hubs."""

from __future__ import annotations

import errno
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh
from msgspec.structs import replace

from pebble.errors import TransportError
from pebble.extensions.media.frames import FrameReader, FrameWriter
from pebble.transports import QoS, TlsSettings, ZenohSettings, create
from pebble.transports.peers import PeerRegistry, prepare_run_dir
from pebble.transports.zenoh import callbacks, wire
from pebble.transports.zenoh.callbacks import direct
from pebble.transports.zenoh.hub import ZenohHub
from pebble.transports.zenoh.hub import journal as journal_module
from pebble.transports.zenoh.hub import store as hub_store
from pebble.transports.zenoh.hub.journal import Journal
from pebble.transports.zenoh.hub.records import Record, Retained, StoredWill
from pebble.transports.zenoh.hub.store import HubStore
from pebble.transports.zenoh.hub.wills import GONE_S, RETURN_S, WillTimes
from pebble.transports.zenoh.session import close_session, open_session, session_config
from pebble.transports.zenoh.wire import Hello, Stamp, Will, digest
from tests.small_disk import SmallDisk
from tests.support import WAIT_S, Clock, needs_root, quickly, refused, until
from tests.transports.zenoh_net import HubProcess

WILL = Will("status", b"gone", QoS.DELIVERED, True)


def retained(key: str, payload: bytes, origin: str = "") -> Retained:
    return Retained(key, payload, Stamp(QoS.DELIVERED, 1, origin))


def store(*records: Record) -> HubStore:
    made = HubStore()
    for record in records:
        made.apply(record)
    return made


def test_apply_returns_whether_anything_changed() -> None:
    made = store()
    for record in (retained("a", b"1"), retained("a", b""), StoredWill("client", WILL), StoredWill("client", None)):
        assert made.apply(record)
        assert not made.apply(record)


@pytest.mark.parametrize(
    ("own", "lacking"),
    [
        ({"new": 1}, ["new"]),
        ({"mine": digest(b"1")}, []),
        ({"mine": digest(b"2")}, ["mine"]),
        ({"mine": None}, ["mine"]),
        ({"theirs": None, "new": None}, []),
    ],
)
def test_a_client_is_asked_for_what_is_missing_or_its_own_and_changed(
    own: dict[str, int | None], lacking: list[str]
) -> None:
    made = store(retained("mine", b"1", "me"), retained("theirs", b"1", "somebody"))
    assert made.lacks(Hello("me", 5, None, own)) == lacking


def test_what_has_no_room_is_refused_and_leaves_the_others_and_its_own_older_value(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit, value in (("MAX_BYTES", 100), ("OVERHEAD", 0), ("MAX_WILLS", 1)):
        monkeypatch.setattr(hub_store, limit, value)
    made = store(retained("a", bytes(90)), retained("b", bytes(20)), retained("a", bytes(95)))
    assert [len(record.payload) for record in made.retained()] == [95]
    assert not made.apply(retained("a", bytes(100)))
    assert [len(record.payload) for record in made.retained()] == [95]
    assert made.apply(retained("a", b""))
    assert made.apply(retained("b", bytes(99)))
    made.apply(StoredWill("first", replace(WILL, payload=b"")))
    assert (made.wills(), made.refused) == (set(), 3)
    made.apply(retained("b", b""))
    made.apply(StoredWill("first", WILL))
    made.apply(StoredWill("second", WILL))
    assert (made.wills(), made.refused) == ({"first"}, 4)
    assert "no room for the retained message of b" in caplog.text
    made.apply(retained("a", b"1", "x" * 1000))
    assert (made.retained(), made.refused) == ([], 5), "long names take room too"


# -- wills, in virtual time

NEVER = float("inf")

Event = Callable[[WillTimes], object]


def hello(at: float, *, alive: bool = True, has_will: bool = True) -> Event:
    return lambda wills: wills.on_hello("c", at, alive=alive, has_will=has_will)


def gone(at: float) -> Event:
    return lambda wills: wills.on_gone("c", at)


def restart(at: float) -> Event:
    return lambda wills: wills.on_restart(["c"], at)


@pytest.mark.parametrize(
    ("events", "due"),
    [
        pytest.param([hello(0), gone(1)], 1 + GONE_S, id="its token is gone"),
        pytest.param([hello(0), gone(1), lambda wills: wills.forget("c")], NEVER, id="it is back"),
        pytest.param([hello(0), gone(1), hello(1.05)], NEVER, id="it says hello again"),
        pytest.param([hello(0, alive=False)], RETURN_S, id="a hello, and no token"),
        pytest.param([hello(0, alive=False, has_will=False)], NEVER, id="a hello without a will"),
        pytest.param([restart(0)], RETURN_S, id="a restart"),
        pytest.param([gone(0), restart(0.05)], GONE_S, id="a restart while it is due"),
    ],
)
def test_when_a_will_is_due(events: list[Event], due: float) -> None:
    wills = WillTimes()
    for event in events:
        event(wills)
    assert wills.next_due == pytest.approx(due)
    assert wills.take_due(due - 1e-6) == []
    assert wills.take_due(due) == ([] if due == NEVER else ["c"])
    assert wills.next_due == NEVER


# -- questions

KEY = "@hub/hello"


@pytest.fixture
def session(tmp_path: Path) -> Iterator[zenoh.Session]:
    opened = open_session(session_config(ZenohSettings(run_dir=tmp_path), "peer", listen=[], connect=[]))
    yield opened
    close_session(opened)


def test_a_network_card_is_named_by_its_number(tmp_path: Path) -> None:
    settings = ZenohSettings(run_dir=tmp_path, connect=("tls/[fe80::1%lo]:7447",), tls=TlsSettings())
    number = socket.if_nametoindex("lo")
    assert f'"tls/[fe80::1%{number}]:7447"' in session_config(settings, "peer", listen=[], connect=[])


def test_a_hub_that_has_just_died_holds_up_no_answer_of_another(session: zenoh.Session) -> None:
    held: list[zenoh.Query] = []
    session.declare_queryable(KEY, direct(held.append))  # it has the question, and never answers
    assert wire.ask(session, KEY, b"", 0.2) is None
    held.clear()
    session.declare_queryable(KEY, direct(lambda query: _answer(query, b"here")))
    with quickly():
        assert wire.ask(session, KEY, b"", WAIT_S) == b"here"
    assert len(held) == 1


def _answer(query: zenoh.Query, payload: bytes) -> None:
    with query:
        query.reply(KEY, payload)


# -- its memory on disk: kills, damage, and disks that are full or missing


RECORDS = [("a", b"one"), ("b", b""), ("c", b"\x00" * 5000), ("d", b"four")]
BYTES = [record for _, record in RECORDS]


def begun(path: Path, clock: Clock | None = None) -> Journal:
    journal = Journal(path, clock=clock or Clock())
    assert journal.load() == []
    journal.rewrite([])
    return journal


def read(path: Path) -> list[bytes]:
    journal = Journal(path)
    try:
        return journal.load()
    finally:
        journal.close()


def test_what_was_put_is_loaded_in_order_and_what_was_removed_is_not(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "journal"
    journal = begun(path)
    for name, record in [("a", b"old"), ("gone", b"x"), *RECORDS]:
        journal.put(name, record)
    journal.put("gone", None)
    assert read(path) == BYTES, "before it is closed: the hub may be killed"
    journal.close()
    assert read(path) == BYTES
    assert [(file.name, file.stat().st_mode & 0o777) for file in path.parent.iterdir()] == [("journal", 0o600)]


@pytest.mark.parametrize(
    "damage",
    [
        lambda _whole: b"\x00\x00\x00\x05\x12\x34\x56\x78of an earlier version",
        lambda whole: whole[:5000],
        lambda whole: whole[:4096] + b"\xff" * (len(whole) - 4096),
    ],
)
def test_a_damaged_file_is_set_aside_with_a_warning(
    tmp_path: Path, damage: Callable[[bytes], bytes], caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "journal"
    journal = begun(path)
    journal.rewrite(RECORDS)
    journal.close()
    damaged = damage(path.read_bytes())
    path.write_bytes(damaged)
    journal = begun(path)
    assert f"journal {path} is damaged" in caplog.text
    assert (tmp_path / "journal.bad").read_bytes() == damaged
    journal.put("a", b"new")
    journal.close()
    assert read(path) == [b"new"]


@needs_root
def test_after_a_moment_of_full_disk_everything_is_written_again(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    caplog.set_level("INFO")
    disk, clock = SmallDisk(tmp_path / "disk"), Clock()
    disk.mount()
    try:
        journal = begun(disk.root / "journal", clock)
        with disk.full():
            for name in "ab":
                journal.put(name, bytes(100_000))
            assert caplog.text.count("is full") == 1
            assert journal.rewrite_at == clock.now + 30
            journal.rewrite([("a", bytes(100_000))])
            assert caplog.text.count("is full") == 1
        journal.rewrite([("a", b"new")])
        journal.put("b", b"later")
        assert journal.rewrite_at == float("inf")
        assert "is written again" in caplog.text
        journal.close()
        assert read(disk.root / "journal") == [b"new", b"later"]
    finally:
        disk.unmount()


def test_a_file_that_was_removed_is_written_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, "SYNC_S", 0.01)
    path = tmp_path / "state" / "journal"
    journal = begun(path)
    shutil.rmtree(path.parent)
    journal.put("b", b"two")
    assert until(lambda: journal.rewrite_at == 1030)
    journal.rewrite([("a", b"one"), ("b", b"two")])
    journal.close()
    assert read(path) == [b"one", b"two"]


def test_a_place_that_cannot_be_written_is_tried_again(caplog: pytest.LogCaptureFixture) -> None:
    journal = begun(Path(path := "/dev/null/journal"))
    journal.put("a", b"not stored")
    assert caplog.text.count(path) == 1
    assert journal.rewrite_at == 1030
    journal.close()


def test_what_could_not_be_read_stays(tmp_path: Path) -> None:
    path, away = tmp_path / "journal", tmp_path / "away"
    journal = begun(path)
    journal.rewrite([("a", b"old"), ("b", b"old")])
    journal.close()
    path.rename(away)
    path.mkdir()
    journal = begun(path)
    path.rmdir()
    away.rename(path)
    journal.rewrite([("b", b"new")])
    journal.close()
    assert read(path) == [b"old", b"new"]


def test_newcomers_are_connected_to_at_once_and_waited_for_when_ready(tmp_path: Path) -> None:
    registry = PeerRegistry(tmp_path)
    first, second = registry.register("first"), registry.register("second")
    assert set(registry.sockets()) == {first.socket, second.socket}
    assert registry.ready() == {}
    first.ready()
    assert registry.ready() == {first.name: "first"}
    assert registry.ready(but=first.name) == {}
    assert registry.sockets(but=first.name) == [second.socket]
    first.release()
    second.release()
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_lock_file_is_no_process(tmp_path: Path) -> None:
    (tmp_path / "folder.seat").mkdir()
    os.mkfifo(tmp_path / "pipe.seat")
    (tmp_path / "link.seat").symlink_to(tmp_path / "nowhere")
    assert PeerRegistry(tmp_path).sockets() == []


def test_a_socket_path_that_is_too_long_is_an_error_that_names_the_setting(tmp_path: Path) -> None:
    longest = tmp_path / ("x" * (107 - len(f"{tmp_path}//12345678.sock")))
    prepare_run_dir(longest)
    assert longest.stat().st_mode & 0o777 == 0o700
    longer = tmp_path / f"{longest.name}x"
    with pytest.raises(TransportError, match=r"too long for a unix socket .*transport.run_dir"):
        prepare_run_dir(longer)
    assert not longer.exists()


USERS: dict[str, Callable[[Path], object]] = {
    "peer": lambda folder: create("zenoh", "peer", ZenohSettings(run_dir=folder)).open(0.0),
    "hub": lambda folder: ZenohHub(ZenohSettings(run_dir=folder)).open(),
    "reader": lambda folder: FrameReader(folder, "camera").open(),
    "writer": lambda folder: FrameWriter(folder, "camera", slots=2, capacity=100).open(),
}


@pytest.mark.parametrize("use", USERS.values(), ids=USERS)
def test_a_folder_that_another_user_made_is_used_by_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, use: Callable[[Path], object]
) -> None:
    (tmp_path / "run").mkdir(mode=0o700)
    monkeypatch.setattr(os, "getuid", lambda: (tmp_path / "run").stat().st_uid + 1)
    with pytest.raises(TransportError, match=f"{tmp_path}/run(:| is not) .* user"):
        use(tmp_path / "run")


def test_a_folder_that_others_may_write_to_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run").chmod(0o770)
    with pytest.raises(TransportError, match="others may write there"):
        prepare_run_dir(tmp_path / "run")
    assert (tmp_path / "run").stat().st_mode & 0o777 == 0o770, "it may be any folder, and not a robot's"


def test_a_full_disk_keeps_no_process_from_being_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    registry = PeerRegistry(tmp_path)
    lock = registry.register("first")
    monkeypatch.setattr(os, "pwrite", refused(errno.ENOSPC))
    lock.ready()
    assert registry.ready() == {lock.name: "?"}
    lock.release()
    assert list(tmp_path.iterdir()) == []


#: Answers with more than the sockets hold: from its handler, or from a thread for which its handler waits meanwhile.
ANSWERING = """
import sys, threading
from pathlib import Path
from pebble.transports import QoS, ZenohSettings, create

def answer():
    for _ in range(int(sys.argv[2])):
        transport.publish("answer", bytes(int(sys.argv[3])), qos=QoS.DELIVERED)

def answer_alone():
    with lock:
        begun.set()
        answer()

def on_request(message):
    if message.payload == b"handler":
        answer()
    elif message.payload == b"thread":
        threading.Thread(target=answer_alone).start()
        begun.wait()
    elif message.payload == b"lock":
        lock.acquire()
        lock.release()

lock, begun = threading.Lock(), threading.Event()
with create("zenoh", "answering", ZenohSettings(run_dir=Path(sys.argv[1]))) as transport:
    transport.subscribe("request", on_request, direct=True)
    print(flush=True)
    sys.stdin.read()
"""
ANSWERS, ANSWER_BYTES = 3000, 1000


@contextmanager
def answering(hub: HubProcess) -> Iterator[None]:
    """A process that is ready to answer."""
    command = [sys.executable, "-c", ANSWERING, str(hub.settings.run_dir), str(ANSWERS), str(ANSWER_BYTES)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdout.readline()
        yield
        process.stdin.close()


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[HubProcess]:
    hub = HubProcess(tmp_path).start()
    yield hub
    hub.end()


@pytest.mark.parametrize("requests", [[b"handler"], [b"thread", b"lock"]], ids=lambda one: one[0].decode())
def test_a_handler_may_wait_for_what_is_published(hub: HubProcess, requests: list[bytes]) -> None:
    """Its thread may be the one that waits for the sockets: the guard has another one do that."""
    received: list[int] = []
    with create("zenoh", "asking", hub.settings) as transport, answering(hub):
        # It keeps no message: thousands of them would make Python's collector look at all that pytest has, which on a
        # busy machine takes the 0.3 s after which a sender gives up (measured).
        transport.subscribe("answer", lambda message: received.append(len(message.payload)), direct=True)
        for number in range(1, 4):
            for request in requests:
                assert transport.publish("request", request, qos=QoS.DELIVERED)
            assert until(lambda enough=number * ANSWERS: len(received) >= enough), len(received)  # type: ignore[misc]
    assert len(received) == 3 * ANSWERS


def test_the_guard_rests_without_callbacks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(callbacks, "_LOOK_S", 0.001)
    guard, calls = callbacks.Guard(), callbacks.Calls()
    guard.watch(calls)
    for _ in range(2):
        calls.begun += 1
        guard.wake()
        assert until(lambda: guard.helped > 0)  # it runs
        assert guard.helped < 500, "it pauses between two looks"
        assert not guard.rests
        calls.ended += 1
        assert until(lambda: guard.rests)
        guard.helped = 0
