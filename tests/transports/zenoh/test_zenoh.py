"""What only the Zenoh transport promises: no single point of failure, nothing open to the world, nothing left over."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import zenoh

from pebble.errors import TransportError
from pebble.transports import Message, QoS, State, TlsSettings, ZenohSettings, create
from pebble.transports.zenoh import publishers, transport, wire
from pebble.transports.zenoh import session as sessions
from pebble.transports.zenoh.hub import ZenohHub, wills
from tests.support import ROOT, SOON_S, WAIT_S, free_port, until
from tests.transports.forked import Forked
from tests.transports.net import Received
from tests.transports.zenoh_net import HubProcess, ZenohNet, stranger_at

DELIVERED = QoS.DELIVERED
WILL = Message("will", b"dead", DELIVERED, True)
CERTIFICATES = ROOT / "tests" / "data" / "tls"


#: A child that may neither use its parent's session nor open one; or, with one more argument, ends as any program does
#: while another thread of its parent holds a lock, for good.
FORKS = """
import os, sys, threading
from pathlib import Path
from pebble.errors import TransportError
from pebble.transports import ZenohSettings, create

def refused(attempt):
    try:
        attempt()
    except TransportError as error:
        return "spawn" in str(error)

settings, held = ZenohSettings(run_dir=Path(sys.argv[1])), threading.Event()
client = create("zenoh", "forks", settings).open(5)
if locked := sys.argv[2:]:
    client.on_state(lambda _state: (held.set(), threading.Event().wait()))
    threading.Thread(target=client.close, daemon=True).start()
    held.wait()
if child := os.fork():
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if locked:
        os.execlp("sh", "sh", "-c", f"exit {code}")
    client.close()
    sys.exit(code)
elif not locked:
    attempts = (
        lambda: client.publish("from/child", b""),
        lambda: client.subscribe("to/child", print),
        lambda: create("zenoh", "child", settings).open(1),
    )
    os.execlp("sh", "sh", "-c", f"exit {sum(map(refused, attempts))}")
"""


def stop(peer: Any) -> None:
    os.kill(peer.pid, signal.SIGSTOP)
    assert until(lambda: Path(f"/proc/{peer.pid}/stat").read_text().split()[2] == "T")


def resume(peer: Any) -> None:
    os.kill(peer.pid, signal.SIGCONT)


def listener(robot: ZenohNet) -> Any:
    """Return a process that receives everything."""
    peer: Any = robot.peer("listener")
    peer.listen()
    return peer


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[ZenohNet]:
    """A robot whose hub keeps no journal."""
    robot = ZenohNet(tmp_path)
    robot.hub = HubProcess(tmp_path / "run")
    robot.start_network()
    yield robot
    robot.close_clients()
    if robot.hub.running:
        robot.hub.kill()


# -- no single point of failure


def test_live_traffic_does_not_need_the_hub(robot: ZenohNet) -> None:
    received, numbers, spoken = Received(), itertools.count(), list[bytes]()
    client, talker = robot.client("client"), robot.peer("talker")
    client.subscribe("talk", received)

    def talk() -> None:
        for number in itertools.islice(numbers, 50):
            spoken.append(b"%d" % number)
            assert talker.publish("talk", spoken[-1])

    talk()
    robot.hub.kill()
    assert until(lambda: client.state is State.CONNECTING)
    talk()
    assert received.until(*spoken)
    robot.hub.start()
    talk()
    assert until(lambda: client.state is State.CONNECTED)
    assert received.until(*spoken)


def test_a_peer_that_starts_without_the_hub_talks_to_its_siblings_at_once(robot: ZenohNet) -> None:
    received, answers, late = Received(), Received(), Received()
    first = robot.client("first")
    first.subscribe("from/+", received)
    robot.hub.kill()
    assert until(lambda: first.state is State.CONNECTING)
    second = robot.client("second", opened=False).open(0.2)
    assert second.publish("from/second", b"1", qos=DELIVERED, retain=True)
    assert (second.state, str(robot.hub.settings.run_dir) in second.problem) == (State.CONNECTING, True)
    second.subscribe("to/second", answers)
    assert first.publish("to/second", b"2", qos=DELIVERED)
    assert received.until(b"1")
    assert answers.until(b"2")
    robot.hub.start()
    assert received.until(b"1", b"1")
    assert [message.retain for message in received.messages] == [False, True]
    robot.client("late").subscribe("from/+", late)
    assert late.until(b"1")


def test_a_hub_whose_files_were_removed_ends(tmp_path: Path) -> None:
    with contextlib.closing(ZenohHub(ZenohSettings(run_dir=tmp_path / "run")).open()) as hub:
        hub.look()
        shutil.rmtree(tmp_path / "run")
        with pytest.raises(TransportError, match="was removed: this hub ends"):
            hub.look()


def test_peers_that_open_at_the_same_instant_receive_each_other(robot: ZenohNet) -> None:
    for _ in range(5):
        received: dict[str, list[bytes]] = {name: [] for name in "abc"}
        clients = {name: create("zenoh", name, robot.settings()) for name in received}
        gate = threading.Barrier(len(clients))

        def come(name: str) -> None:
            gate.wait(WAIT_S)  # noqa: B023
            clients[name].open(WAIT_S).subscribe("all", lambda message: received[name].append(message.payload))  # noqa: B023
            gate.wait(WAIT_S)  # noqa: B023
            clients[name].publish("all", name.encode(), qos=DELIVERED)  # noqa: B023

        threads = [threading.Thread(target=come, args=(name,)) for name in received]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(WAIT_S)
        assert until(lambda: all(sorted(got) == [b"a", b"b", b"c"] for got in received.values())), received  # noqa: B023
        for client in clients.values():
            client.close()


# -- siblings that hang


def test_a_stopped_sibling_does_not_delay_the_others(robot: ZenohNet) -> None:
    sender = robot.client("sender")
    fast, stopped = listener(robot), listener(robot)
    stop(stopped)
    times = []
    for _ in range(150):
        before = time.monotonic()
        assert sender.publish("drive", bytes(100_000), qos=DELIVERED)
        times.append(time.monotonic() - before)
    sender.publish("drive", b"end", qos=DELIVERED)
    assert until(lambda: fast.heard() == [151, "end"])
    assert max(times) < SOON_S
    assert sum(taken > 0.25 for taken in times) <= 10, "its sockets are full: a bounded wait, once"
    resume(stopped)


def test_more_topics_than_publishers_are_received_in_order(robot: ZenohNet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those that strangers invent: Zenoh stores 2.4 KB in the hub for each key that ever had a publisher."""
    monkeypatch.setattr(publishers, "PUBLISHERS", 3)
    received: dict[str, list[int]] = {}
    robot.client("receiver").subscribe("many/+", lambda m: received.setdefault(m.topic, []).append(int(m.payload)))
    sender: Any = robot.client("sender")
    sender.policy.is_invented = lambda topic: topic == "many/0"
    for number in range(70):
        assert sender.publish(f"many/{number % 7}", b"%d" % number, qos=QoS(number % 2), urgent=number % 3 == 0)
    assert until(lambda: sum(map(len, received.values())) == 70)
    assert received == {f"many/{topic}": list(range(topic, 70, 7)) for topic in range(7)}
    assert [topic for topic, _ in sender._publishers.declared] == ["many/1", "many/2", "many/3"]


def test_retained_state_missed_while_one_connection_was_down_comes_with_it(robot: ZenohNet) -> None:
    """The connection to a sibling is closed under a flood while the hub's stays: only the hub has what we missed."""
    sender, stalled = robot.client("sender"), listener(robot)
    sender.publish("state", b"old", qos=DELIVERED, retain=True)
    assert until(lambda: stalled.heard() == [1, "old"])
    stop(stalled)
    while len(sender.session.info.links()) > 1:
        sender.publish("flood", bytes(100_000), qos=DELIVERED)
    sender.publish("state", b"new", qos=DELIVERED, retain=True)
    resume(stalled)
    assert until(lambda: stalled.heard()[1] == "new")


def test_a_will_survives_a_hub_without_a_journal(robot: ZenohNet) -> None:
    received: list[Message] = []
    client = robot.client("client")
    client.subscribe("will", received.append)
    mortal = robot.peer("mortal", will=WILL)
    robot.hub.kill()
    robot.hub.start()
    assert until(lambda: client.state is State.CONNECTED)
    robot.hub.wait_until_stored()  # every client has registered again
    assert received == []
    mortal.kill()
    assert until(lambda: [m.payload for m in received] == [b"dead"])


# -- nothing open to the world


def test_nothing_listens_on_any_network(robot: ZenohNet) -> None:
    """Processes of their own show it: sockets of this one may be those of other tests, or of a resolver's thread."""
    talking: Any = robot.peer("talking")
    listening = listener(robot)
    assert talking.publish("a", b"x")
    assert until(lambda: listening.heard() == [1, "x"])
    assert _reachable(robot.hub.pid, talking.pid, listening.pid) == set()
    with socket.create_server(("127.0.0.1", 0)) as server, socket.socket(type=socket.SOCK_DGRAM) as datagrams:
        datagrams.bind(("127.0.0.1", 0))
        assert {str(os.fstat(one.fileno()).st_ino) for one in (server, datagrams)} <= _reachable(os.getpid())


def _reachable(*pids: int) -> set[str]:
    """The sockets of these processes that a packet could reach."""
    lines = [line.split() for table in ("udp", "udp6", "raw") for line in _table(table)]
    listening = [fields for table in ("tcp", "tcp6") for fields in map(str.split, _table(table)) if fields[3] == "0A"]
    return {fields[9] for fields in lines + listening} & _inodes_of(*pids)


def _table(name: str) -> list[str]:
    return Path(f"/proc/net/{name}").read_text().splitlines()[1:]


def _inodes_of(*pids: int) -> set[str]:
    links = [str(path.readlink()) for pid in pids for path in Path(f"/proc/{pid}/fd").iterdir() if path.is_symlink()]
    return {link.removeprefix("socket:[").rstrip("]") for link in links if link.startswith("socket:")}


def test_two_robots_linked_by_tls_share_one_link_and_no_more(robot: ZenohNet, tmp_path: Path) -> None:
    other = ZenohNet(tmp_path / "other")
    other.start_network()
    endpoint = f"tls/localhost:{free_port()}"
    try:
        server = robot.client("server", listen=(endpoint,), tls=_tls("server"))
        bystander, received = Received(), Received()
        robot.client("bystander").subscribe("#", bystander)
        server.subscribe("#", received)
        guest = other.client("guest", connect=(endpoint,), tls=_tls("client"))
        assert until(lambda: guest.publish("hello", b"guest", qos=DELIVERED) and received.payloads)
        assert set(received.payloads) == {b"guest"}
        stranger = other.client("stranger", connect=(endpoint,), tls=TlsSettings(ca_cert=CERTIFICATES / "ca.crt"))
        stranger.publish("hello", b"stranger", qos=DELIVERED)
        server.publish("hello", b"end", qos=DELIVERED)
        assert until(lambda: b"end" in received.payloads and b"end" in bystander.payloads)
        assert (b"stranger" in received.payloads, bystander.payloads) == (False, [b"end"])
    finally:
        other.stop()


def test_only_certificates_with_an_allowed_name_get_through(tmp_path: Path) -> None:
    """The others have the same authority, and are connected."""
    endpoint = f"tls/localhost:{free_port()}"
    listening = {"listen": (endpoint,), "tls": _tls("server"), "allowed_names": ("client",)}
    local = ZenohSettings(run_dir=tmp_path / "run")
    elsewhere = ZenohSettings(run_dir=tmp_path / "other", connect=(endpoint,), client=True)
    with contextlib.ExitStack() as stack:
        hub = ZenohHub(replace(local, **listening)).open()
        stack.callback(hub.close)
        robot = stack.enter_context(create("zenoh", "robot", local))
        received = Received()
        robot.subscribe("#", received)
        stranger = stack.enter_context(stranger_at(replace(elsewhere, tls=_tls("server"))))
        overheard: list[str] = []
        take = zenoh.handlers.Callback(lambda sample: overheard.append(str(sample.key_expr)), indirect=False)
        stranger.declare_subscriber("**", take, allowed_origin=zenoh.Locality.REMOTE)
        stranger.put("drive", b"stranger")
        stamp = wire.Stamp(DELIVERED, 1, "stranger").pack()
        stranger.put(wire.RETAINED + "parked", b"stranger", attachment=stamp)
        assert list(stranger.get(wire.RETAINED + "**", timeout=0.5)) == []
        guest = stack.enter_context(create("zenoh", "guest", replace(elsewhere, tls=_tls("client"))))
        guest.subscribe("#", received)
        assert until(lambda: guest.publish("drive", b"guest", qos=DELIVERED) and b"guest" in received.payloads)
        robot.publish("state", b"robot", qos=DELIVERED, retain=True)
        assert until(
            lambda: (
                b"robot" in received.payloads
                and [(one.key, one.payload) for one in hub.store.retained()] == [("state", b"robot")]
            )
        )
        assert (overheard, b"stranger" in received.payloads) == ([], False)


def _tls(name: str) -> TlsSettings:
    return TlsSettings(
        ca_cert=CERTIFICATES / "ca.crt",
        client_cert=CERTIFICATES / f"{name}.crt",
        client_key=CERTIFICATES / f"{name}.key",
    )


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"connect": ("udp/192.168.0.5:7447",)}, "unencrypted"),
        ({"connect": ("tls/robot:7447",)}, "needs transport.tls"),
        ({"run_dir": Path("/tmp/a?b")}, "transport.run_dir"),
        ({"run_dir": Path("/proc/nowhere")}, "transport.run_dir"),
        ({"listen": ("quic/0.0.0.0:7447",), "tls": TlsSettings()}, "without transport.tls.ca_cert anybody"),
        ({"listen": ("tls/nonsense",), "tls": TlsSettings(ca_cert=CERTIFICATES / "ca.crt")}, "zenoh"),
    ],
)
def test_settings_that_can_never_work_are_refused(tmp_path: Path, changes: dict[str, Any], complaint: str) -> None:
    settings = replace(ZenohSettings(run_dir=tmp_path), **changes)
    transport = create("zenoh", "client", settings)
    with pytest.raises(TransportError, match=complaint):
        transport.open(0.1)
    assert (transport.state, list(tmp_path.iterdir())) == (State.CLOSED, [])


# -- nothing left behind


def test_the_run_directory_is_private_and_empty_in_the_end(robot: ZenohNet) -> None:
    assert robot.hub.settings.run_dir.stat().st_mode & 0o777 == 0o700
    clients = [robot.client(name) for name in ("a", "b")] + [robot.client("tool", client=True)]
    assert len(list(robot.hub.settings.run_dir.glob("*.sock"))) == 3
    for client in clients:
        client.close()
    assert robot.hub.end() == (0, "")
    assert list(robot.hub.settings.run_dir.iterdir()) == []


def test_a_run_that_ends_late_takes_no_part_in_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The transport is opened again while the first run still tries to open a session."""
    begun, goes_on = threading.Event(), threading.Event()

    def open_session(_config: zenoh.Config) -> zenoh.Session:
        begun.set()
        goes_on.wait(WAIT_S)
        raise zenoh.ZError("no hub")

    monkeypatch.setattr(transport, "OPEN_SYNC_S", 0.0)
    monkeypatch.setattr(transport, "HUB_ANSWER_S", 0.0)
    monkeypatch.setattr(sessions, "open_session", open_session)
    client = create("zenoh", "late", ZenohSettings(run_dir=tmp_path / "run", client=True)).open(0)
    assert begun.wait(WAIT_S)
    client.close()
    client.open(0)
    runs = [thread for thread in threading.enumerate() if thread.name == "pebble-zenoh late"]
    goes_on.set()
    assert (len(runs), until(lambda: not runs[0].is_alive()), runs[1].is_alive()) == (2, True, True)
    client.close()


def test_no_thread_of_zenoh_takes_signals_away_from_the_main_thread(robot: ZenohNet) -> None:
    """A hub whose SIGTERM went elsewhere would wait for ever."""
    blocked = {
        (task / "comm").read_text().strip(): int((task / "status").read_text().split("SigBlk:")[1].split()[0], 16)
        for task in Path(f"/proc/{robot.hub.pid}/task").iterdir()
    }
    zenohs = {name: mask for name, mask in blocked.items() if re.match(r"(app|net|acc|rx|tx)-", name)}
    assert len(zenohs) > 2
    assert all(mask >> (signal.SIGTERM - 1) & 1 for mask in zenohs.values())
    assert not blocked["python"] >> (signal.SIGTERM - 1) & 1


def test_what_the_killed_leave_is_cleared_away_by_the_next(robot: ZenohNet) -> None:
    listener(robot).kill()
    assert len(list(robot.hub.settings.run_dir.glob("*.seat"))) == 1
    robot.hub.kill()
    assert (robot.hub.settings.run_dir / "hub.sock").exists()
    robot.hub.start()
    client = robot.client("client")
    assert client.state is State.CONNECTED
    assert len(list(robot.hub.settings.run_dir.glob("*.seat"))) == 1
    client.close()
    robot.hub.end()
    assert list(robot.hub.settings.run_dir.iterdir()) == []


@pytest.mark.parametrize(("locked", "code"), [([], 3), (["locked"], 0)])
def test_a_fork_is_refused_and_ends_whatever_its_parent_was_doing(
    robot: ZenohNet, locked: list[str], code: int
) -> None:
    command = [sys.executable, "-c", FORKS, str(robot.hub.settings.run_dir), *locked]
    assert subprocess.run(command, cwd=ROOT, timeout=30, check=False).returncode == code


# -- the hub


def test_a_second_hub_is_refused(robot: ZenohNet) -> None:
    with pytest.raises(TransportError, match=r"there is a hub .* already"):
        ZenohHub(robot.settings()).open()
    second = Forked("pebble.extensions.lab.rig.hub", [json.dumps({"run_dir": str(robot.hub.settings.run_dir)})])
    assert second.wait(WAIT_S) == 1
    assert "there is a hub for " in second.printed
    assert robot.client("client").state is State.CONNECTED


def test_a_hub_that_meets_another_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    endpoint = f"tcp/localhost:{free_port()}#iface=lo"
    first = ZenohSettings(run_dir=tmp_path / "first", listen=(endpoint,))
    second = ZenohSettings(run_dir=tmp_path / "second", connect=(endpoint,))
    with contextlib.closing(ZenohHub(first).open()), contextlib.closing(ZenohHub(second).open()):
        assert until(lambda: "another hub is connected to this one" in caplog.text)


def test_a_hello_of_a_client_that_is_gone_leaves_a_will(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wills, "RETURN_S", 0.1)
    settings = ZenohSettings(run_dir=tmp_path / "run")
    hello = ["gone", 0, ["status", b"gone", DELIVERED, True], {}]  # as clients of every version send it
    with contextlib.closing(ZenohHub(settings).open()) as hub, create("zenoh", "client", settings) as client:
        session: zenoh.Session = client.session  # type: ignore[attr-defined]
        session.liveliness().declare_token(wire.LIVE + "gone").undeclare()
        assert wire.ask(session, wire.HELLO, wire.encode(hello), 5.0) is not None
        assert until(lambda: [(one.key, one.payload) for one in hub.store.retained()] == [("status", b"gone")])


def test_nonsense_does_not_disturb_the_hub(robot: ZenohNet) -> None:
    client = robot.client("client")
    session: zenoh.Session = client.session  # type: ignore[attr-defined]
    for stamp in (None, b"", b"\xff" * 9, b"\x05" + bytes(8) + b"name"):
        session.put(wire.RETAINED + "nonsense", b"x", attachment=stamp)
    for what in (wire.HELLO, wire.BYE, wire.RETAINED + "**"):
        for payload in (b"\xc1", b"\x00", wire.encode(["x", "y", "z", 1])):
            assert [reply for reply in session.get(what, payload=payload, timeout=2) if reply.ok is not None] == []
    client.publish("sense", b"1", qos=DELIVERED, retain=True)
    received: list[Message] = []
    robot.client("late").subscribe("#", received.append)
    assert until(lambda: [(m.topic, m.payload) for m in received] == [("sense", b"1")])


def test_a_message_that_waited_in_a_socket_too_long_is_dropped(
    robot: ZenohNet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The age is that after a SIGSTOP of the receiver; retained messages are accepted: they are not sent again."""
    sender, client = robot.client("sender"), robot.client("client")
    received: list[Message] = []
    client.subscribe("#", received.append)
    now = wire.since_boot_ns
    with monkeypatch.context() as past:
        past.setattr(wire, "since_boot_ns", lambda: now() - 2_500_000_000)
        stale, retained = (
            wire.pack_live(DELIVERED, retain_requested=retain_requested) for retain_requested in (False, True)
        )
    session: zenoh.Session = sender.session  # type: ignore[attr-defined]
    session.put("drive", b"stale", attachment=stale, **wire.BLOCK)
    session.put("state", b"old", attachment=retained, **wire.BLOCK)
    sender.publish("drive", b"fresh", qos=DELIVERED)
    assert until(lambda: [m.payload for m in received] == [b"old", b"fresh"])
    assert client.counters["late"] == 1


def test_a_taken_port_keeps_no_robot_from_its_hub(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with socket.create_server(("127.0.0.1", 0)) as stranger:
        endpoint = f"tcp/localhost:{stranger.getsockname()[1]}#iface=lo"
        settings = ZenohSettings(run_dir=tmp_path / "run", listen=(endpoint,))
        fact = f"transport.listen: {endpoint}: Address already in use (by process {os.getpid()} of user {os.getuid()}: "
        with pytest.raises(TransportError, match=re.escape(fact)):  # its endpoints are all that it is for
            ZenohHub(settings).open()
        hub = ZenohHub(replace(settings, of_robot=True)).open()
        hub.close()
        assert fact in caplog.text
        assert "the robot runs without it: end that process and start the robot again" in caplog.text
