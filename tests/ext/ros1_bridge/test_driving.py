"""A base is driven, halted, latched and freed: what it hears, whatever happens to master, base and bridge."""

from __future__ import annotations

import signal
import socket
import threading
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest

from pebble.config import Config
from pebble.contract.payloads import Drive
from pebble.motors.state_file import StateFile
from pebble.services.ros1_bridge import cmd_vel
from pebble.services.ros1_bridge.cmd_vel import CmdVel
from pebble.services.ros1_bridge.config import Ros1
from pebble.services.ros1_bridge.messages import GOAL_ID, GOAL_STATUS, TWIST
from pebble.services.ros1_bridge.node import Node
from pebble.services.ros1_bridge.wire import RosError
from pebble.services.ros1_bridge.xmlrpc_api import call, serve
from tests.ext.ros1_bridge.conftest import Husky, World
from tests.support import WAIT_S, until

TOPIC = "/cmd_vel"


def node_of(ros: World, name: str = "pebble_ros1_bridge") -> Node:
    return Node(name, ros.uri, "127.0.0.1", lambda _why: None)


def test_a_command_becomes_a_twist_and_ends_in_zeros_then_silence(
    husky: Husky, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rule 2, with x to the right; its odometry, diagnostics and planner are published."""
    monkeypatch.delattr(Config, "section")  # a search through the whole config, longer than the rest of a command
    begin = time.monotonic_ns()
    last = husky.send(x=0.5, z=1.0)
    assert until(lambda: husky.ros.moves(begin))
    moved, _, speeds = husky.ros.moves(begin)[0]
    assert speeds == ["0.600000", "-0.600000"]
    assert until(lambda: len(husky.ros.zeros(moved)) >= 5)
    first_zero = husky.ros.zeros(moved)[0][0]
    assert 0.6 < (first_zero - last) / 1e9 < 1.6, "0.75 s after the last command, on a machine that is not busy"
    time.sleep(0.6)
    assert husky.ros.moves(first_zero) == []
    assert len(husky.ros.zeros(moved)) <= 7
    count = len(husky.ros.rows(begin))
    time.sleep(0.3)
    assert len(husky.ros.rows(begin)) == count, "other programs of ROS may drive"
    assert husky.world.newest("wheel-odometry")["unit"] == "mm"
    newest = husky.world.newest
    assert until(lambda: newest("diagnostics").get("value", {}).get("label") == "OK")
    assert until(lambda: newest("navigation-status").get("value", {}).get("label") == "UNKNOWN")


def test_its_sender_stops_the_base_although_the_service_hangs(ros: World) -> None:
    """Rule 2: the first dead man. A speed that is no number is none."""
    node = node_of(ros)
    sender = CmdVel(node, TOPIC, 0.05, None, None)
    node.start()
    sender.open()
    try:
        assert until(lambda: sender.bases)
        begin = time.monotonic_ns()
        sender.drive(0.4, 0.0, 0.3)
        assert until(lambda: ros.zeros(begin) and ros.moves(begin))
        assert until(lambda: ros.zeros(ros.moves(begin)[-1][0]))
        assert (ros.zeros(ros.moves(begin)[-1][0])[0][0] - begin) / 1e9 < 1.0
        assert len(ros.moves(begin)) <= 6, "once, then every 0.05 s"
        begin = time.monotonic_ns()
        sender.drive(0.4, 0.0, 5.0)
        assert until(lambda: ros.moves(begin))
        sender.drive(float("nan"), 0.0, 5.0)
        assert until(lambda: ros.zeros(begin))
        time.sleep(0.4)
        assert ros.moves(ros.zeros(begin)[0][0]) == []
    finally:
        sender.close()
        node.close()


def test_the_service_stops_the_base_although_its_sender_hangs(
    ros: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rule 2: the second dead man."""
    monkeypatch.setattr(CmdVel, "open", lambda self: None)
    monkeypatch.setattr(CmdVel, "close", lambda self: None)
    monkeypatch.setattr(CmdVel, "alive", True)
    husky = Husky(ros, tmp_path).ready()
    begin = husky.send(z=0.5)
    assert until(lambda: husky.ros.zeros(begin + 10_000_000))
    assert len(husky.ros.moves(begin)) <= 1
    husky.end()


def test_a_stopped_base_gets_zeros_the_lock_and_no_goal_also_after_a_restart(husky: Husky) -> None:
    """Rules 1 and 4: whatever is sent to it, until it is reset."""
    assert husky.ros.locks() == [], "who has locked nothing opens nothing"
    husky.drive(0.5)
    begin = time.monotonic_ns()
    husky.stop_it()
    husky.drive(1.0)
    assert until(lambda: len(husky.ros.locks(begin)) >= 5), "it is repeated"
    assert set(husky.ros.locks(begin)) == {"True"}
    stopped = husky.ros.zeros(begin)[0][0]
    assert until(lambda: len(husky.ros.zeros(stopped)) >= 5)
    assert husky.ros.moves(stopped) == []
    assert husky.ros.rows(begin, "cancel")
    again = time.monotonic_ns()
    locks = partial(husky.ros.locks, again)
    assert until(lambda: husky.bridge.halt() or len(locks()) > 3, step=0.02), "who stops it again delays no lock"
    husky.end()
    again = time.monotonic_ns()
    husky.ready()
    husky.drive(0.3)
    assert until(lambda: "True" in husky.ros.locks(again))
    assert husky.ros.rows(again)[0] in husky.ros.zeros(again)
    reset = time.monotonic_ns()
    husky.reset()
    assert until(lambda: husky.ros.locks(reset)[-1:] == ["False"])
    time.sleep(0.6)
    assert husky.ros.moves(stopped) == []
    assert husky.is_obeyed()


def test_a_new_base_hears_a_zero_first_and_a_lock_while_it_is_stopped(
    husky: Husky, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rule 3, while it is driven; then rule 4, with a bridge that is killed before the lock is open."""
    done = threading.Event()
    driver = threading.Thread(target=lambda: [husky.drive(0.2) for _ in iter(done.is_set, True)])
    driver.start()
    try:
        husky.ros.kill("base")
        up = husky.ros.start_base()
        assert until(lambda: husky.ros.moves(up)), "and then it is driven"
        assert husky.ros.rows(up)[0] in husky.ros.zeros(up)
    finally:
        done.set()
        driver.join()
    husky.stop_it()
    husky.ros.kill("base")
    up = husky.ros.start_base()
    assert until(lambda: husky.ros.locks(up))
    assert set(husky.ros.locks(up)) == {"True"}
    husky.ros.kill("base", signal.SIGSTOP)  # its system takes what is sent to it
    with monkeypatch.context() as busy:
        busy.setattr(cmd_vel, "_SURE_S", WAIT_S)
        husky.reset()
        husky.ros.kill("base")
        husky.end()
    husky.start()
    up = husky.ros.start_base()
    assert until(lambda: husky.ros.locks(up)), "an earlier life has locked it"
    assert set(husky.ros.locks(up)) == {"False"}
    assert until(lambda: StateFile(husky.config.state_file("lock-ros1")).load() is False)
    husky.end()
    husky.ready()
    husky.ros.kill("base")
    up = husky.ros.start_base()
    assert until(lambda: husky.ros.rows(up))
    time.sleep(0.3)
    assert husky.ros.locks(up) == [], "who has locked nothing in this life opens nothing"


@pytest.mark.parametrize("cancels", [True, False])
def test_a_person_who_drives_cancels_navigation(ros: World, tmp_path: Path, cancels: bool) -> None:
    """Rule 5: a multiplexer may prefer the planner."""
    husky = Husky(ros, tmp_path, drive={"cancels_navigation": cancels}).ready()
    ros.do("goal active")
    assert until(lambda: husky.world.newest("navigation-status").get("value", {}).get("active"))
    assert until(lambda: husky.world.newest("navigation-goal").get("value", {}).get("x_m") == 1.0)
    for drive, cancelled in ((Drive(z=0.5, source="autonomy", run=1), False), (Drive(z=0.5), cancels)):
        begin = time.monotonic_ns()
        for _ in range(3):
            husky.bridge.move(drive, 0.2)
        assert until(lambda begin=begin: ros.rows(begin, "cancel"), WAIT_S if cancelled else 0.5) is cancelled  # type: ignore[misc]
        assert len(ros.rows(begin, "cancel")) <= 1, "once a second"
    husky.end()


def test_a_base_that_sends_no_odometry_any_more_gets_no_moves(husky: Husky) -> None:
    """Rule 6: what it hears after it hung would be old."""
    husky.drive(0.3)
    husky.ros.do("quiet")
    assert until(lambda: husky.bridge.assess()[0] == "absent")
    assert "no odometry" in husky.bridge.assess()[2]
    begin = time.monotonic_ns()
    husky.drive(0.5)
    assert husky.ros.moves(begin) == []
    assert until(lambda: husky.bridge.cmd_vel.held_back)
    husky.ros.do("loud")
    assert until(lambda: husky.bridge.assess() == ("ready", 0, ""))
    assert husky.is_obeyed()


def test_a_subscriber_that_is_not_connected_is_told_again(ros: World) -> None:
    """Rule 7: by another path, since rospy ignores an address to which it believes to be connected."""
    node, told = node_of(ros), []

    class Deaf:
        master = ros.uri

        def publishers_are(self, topic: str, uris: list[str]) -> None:
            told.extend(uri for uri in uris if topic == TOPIC)

        def address_of(self, topic: str) -> None:
            return None

    hung = socket.create_server(("127.0.0.1", 0))  # it answers no call, which must not keep others waiting
    call(ros.uri, "registerSubscriber", "/hung", TOPIC, TWIST.kind, f"http://127.0.0.1:{hung.getsockname()[1]}/")
    deaf = serve(Deaf(), "127.0.0.1", lambda: None)  # type: ignore[arg-type]  # it is asked for nothing else
    threading.Thread(target=deaf.serve_forever, daemon=True).start()
    call(ros.uri, "registerSubscriber", "/deaf", TOPIC, TWIST.kind, f"http://127.0.0.1:{deaf.server_address[1]}/")
    node.advertise(TOPIC, TWIST, "")
    heard = threading.Event()
    node.subscribe("/move_base/status", GOAL_STATUS, lambda _body: heard.set())
    node.start()
    assert until(lambda: any(uri.startswith(node.uri) and uri != node.uri for uri in told)), told
    ros.kill("base")
    heard.clear()
    ros.start_base()
    assert heard.wait(5), "a publisher is connected to meanwhile"
    node.close()
    deaf.shutdown()
    hung.close()


def test_of_two_bridges_with_one_name_the_second_waits(husky: Husky, caplog: pytest.LogCaptureFixture) -> None:
    """Rule 8: to register ends the other, which would register again, and so on."""
    second = node_of(husky.ros)
    CmdVel(second, TOPIC, 0.05, None, None)
    second.start()
    assert until(lambda: second.problem.startswith("another node is called"))
    assert husky.is_obeyed(), "the first one drives on"
    husky.drive(1.0)
    assert not second.registered
    assert "has ended this node" not in caplog.text
    husky.end()
    assert until(lambda: second.registered), "its name is free"
    second.close()
    husky.start()


def test_a_node_that_is_ended_halts_and_returns_once_its_name_is_free(husky: Husky) -> None:
    """Rule 8: another one that took the name may drive."""
    husky.drive(0.3)
    begin = husky.drive(0.2)
    call(husky.bridge.node.uri, "shutdown", "/master", "new node registered with same name")
    assert until(lambda: husky.ros.zeros(begin))
    state, _, why = husky.bridge.assess()
    assert (state, "has ended this node" in why) == ("absent", True)
    assert until(lambda: husky.bridge.assess()[0] == "ready")
    assert husky.is_obeyed()
    other = node_of(husky.ros, "teleop")
    other.advertise(TOPIC, TWIST, "")
    other.advertise("/move_base/cancel", GOAL_ID, "")  # as each client of a planner does
    other.start()
    named = ("ready", 0, "others publish /cmd_vel as well: /teleop")
    assert until(lambda: husky.bridge.assess() == named), "rule 9"
    other.close()


def test_a_master_that_is_killed_and_comes_back_is_registered_with_again(husky: Husky) -> None:
    husky.ros.kill("master")
    assert until(lambda: not husky.bridge.node.registered)
    assert husky.is_obeyed(), "open connections stay"
    husky.ros.start_master()
    assert until(lambda: husky.bridge.node.registered)
    husky.ros.kill("base")
    up = husky.ros.start_base()
    assert until(lambda: husky.ros.rows(up))
    assert husky.ros.rows(up)[0] in husky.ros.zeros(up)


def test_a_base_that_hung_hears_few_old_moves_and_then_a_zero(husky: Husky) -> None:
    husky.drive(0.5)
    husky.ros.kill("base", signal.SIGSTOP)
    husky.drive(2.5)
    assert until(lambda: husky.bridge.assess()[0] == "absent")
    begin = time.monotonic_ns()
    husky.ros.kill("base", signal.SIGCONT)
    assert until(lambda: husky.ros.zeros(begin))
    burst = [row for row in husky.ros.moves(begin) if row[0] < husky.ros.zeros(begin)[0][0]]
    assert len(burst) < 70, "of the second before it was taken for hung"


def test_strangers_are_bounded_and_keep_nobody_out(husky: Husky) -> None:
    """Rule 10: connections that say nothing, calls that do not end, and what is of no known topic."""
    node = husky.bridge.node
    _, _, port = call(node.uri, "requestTopic", "/x", TOPIC, [["TCPROS"]])
    silent = [socket.create_connection(("127.0.0.1", port)) for _ in range(40)]
    api = int(node.uri.rsplit(":", 1)[1].strip("/"))
    callers = [socket.create_connection(("127.0.0.1", api)) for _ in range(20)]
    assert until(lambda: {"ros_greetings", "ros_calls"} <= node.dropped().keys()), node.dropped()
    assert husky.is_obeyed(), "who is connected is driven"
    for sock in silent:
        sock.settimeout(WAIT_S)
        assert sock.recv(1) == b""
    for sock in callers:
        sock.close()

    def answers() -> bool:
        with suppress(RosError):  # while it notices that the others have gone
            return node.registered and bool(call(node.uri, "getPid", "/x"))
        return False

    assert until(answers)
    for greeting, answer in ((b"\x10\x00\x00\x00\x0c\x00\x00\x00topic=/other", b"error="), (b"\xff\xff\xff\xff", b"")):
        with socket.create_connection(("127.0.0.1", port)) as sock:
            sock.settimeout(WAIT_S)
            sock.sendall(greeting)
            received = sock.recv(1000)
            assert (answer in received, bool(answer)) == (True, bool(received))


def test_it_listens_on_this_machine_alone_unless_told_otherwise(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Rule 10."""
    for name in ("ROS_IP", "ROS_HOSTNAME", "ROS_MASTER_URI"):
        monkeypatch.delenv(name, raising=False)
    assert (Ros1().host(), Ros1().master()) == ("127.0.0.1", "http://127.0.0.1:11311")
    monkeypatch.setenv("ROS_HOSTNAME", "husky.lab")
    monkeypatch.setenv("ROS_MASTER_URI", "http://base:11311")
    assert (Ros1().host(), Ros1().master()) == ("husky.lab", "http://base:11311")
