"""What a robot's connections, its hub and its programs are set up with, and how its files are written."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import threading
from collections.abc import Callable
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest

from pebble.config import parse
from pebble.contract import ESTOP
from pebble.errors import PebbleError
from pebble.extensions.fleet.files import GatewayFile, gateway_transports
from pebble.extensions.fleet.gateway.gateway import will
from pebble.runtime.connections import hub_settings, local_settings, mqtt_settings, remote_transport, stops_transport
from pebble.runtime.environment import child_environment, withhold
from pebble.runtime.hub import WILLS
from pebble.runtime.whole_file import write
from pebble.transports import Message, MqttSettings, QoS, ZenohSettings, create
from pebble.transports.hosts import SMALL_SEGMENT
from pebble.transports.topics import matches
from pebble.transports.zenoh import wire
from pebble.transports.zenoh.hub.admission import Admission
from pebble.transports.zenoh.hub.intake import ASKED_BYTES, QUEUE_BYTES, SENDERS, Intake
from pebble.transports.zenoh.hub.journal import Journal
from pebble.transports.zenoh.hub.records import StoredWill
from pebble.transports.zenoh.wire import Will
from tests.sparing_broker import SparingBroker
from tests.support import Broker, refused, until
from tests.transports.net import ProcessPeer
from tests.transports.zenoh_net import HubProcess

BASE = "pebble/robots/goob"


@pytest.mark.parametrize(
    ("topic", "remote", "local"),
    [
        (f"{BASE}/outgoing/online", True, True),
        (f"{BASE}/outgoing/estop/wheels", True, True),
        (f"{BASE}/outgoing/control/by", True, True),
        (f"{BASE}/outgoing/capabilities", True, True),
        ("site/alive", True, True),
        ("site/drive", True, True),
        (f"{BASE}/incoming/estop", False, True),
        (f"{BASE}/incoming/soundboard-command", False, True),
        (f"{BASE}/outgoing/touch-sensors", False, False),
        (f"{BASE}/outgoing/status", False, False),
    ],
)
def test_vital_topics_are_never_withheld(topic: str, remote: bool, local: bool, tmp_path: Path) -> None:
    broker = {"host": "127.0.0.1"}
    services = {
        "mqtt_bridge": {"enabled": True, "remote_mqtt": broker, "heartbeat": {"topic": "site/alive"}},
        "serial_mcu_bridge": {"topics": {"drive_values": "site/drive"}},
    }
    document = {"robot": {"id": "goob"}, "transport": {"kind": "mqtt"}, "local_mqtt": broker, "services": services}
    config = parse(document, folder=tmp_path, env={})
    tool = mqtt_settings(config.services.mqtt_bridge.remote_mqtt, reconnect_max_s=1.0)
    settings = (remote_transport(config, "remote-bridge").settings, local_settings(config))  # type: ignore[attr-defined]
    assert [any(matches(one, topic) for one in each.vital) for each in settings] == [remote, local]
    assert any(matches(one, topic) for one in tool.vital) == (local and not topic.startswith("site/"))


@pytest.mark.parametrize("program", ["bridge", "gateway"])
def test_a_live_stop_waits_for_none_that_a_broker_keeps(program: str, tmp_path: Path) -> None:
    topic, broker = ESTOP.topic(BASE), Broker(tmp_path)
    sparing = SparingBroker(broker.port, longest=1500)
    mqtt: dict[str, Any] = {"host": "127.0.0.1", "port": sparing.port, "protocol": "5"}
    bridge = {"security": {"level": "login"}, "services": {"mqtt_bridge": {"enabled": True, "remote_mqtt": mqtt}}}
    gateway = msgspec.convert({"boards": mqtt, "mqtt": mqtt}, GatewayFile)
    stops = {
        "bridge": stops_transport(parse({"robot": {"id": "goob"}, **bridge}, folder=tmp_path, env={})),
        "gateway": gateway_transports(gateway, gateway.mqtt, tmp_path, will("gate"))[-1],
    }[program]
    received: list[bytes] = []
    with ExitStack() as opened:
        opened.callback(broker.stop)
        opened.callback(sparing.close)
        sender = opened.enter_context(closing(create("mqtt", "ann", MqttSettings(host="127.0.0.1", port=broker.port))))
        sender.open()
        sender.publish(topic, b"x" * 5000, retain=True)
        opened.enter_context(closing(stops)).open()
        stops.subscribe(topic, lambda message: received.append(message.payload), direct=True)
        sender.publish(topic, b"stop")
        assert until(lambda: received == [b"stop"])
        assert sparing.segment <= SMALL_SEGMENT


def test_the_launchers_variables_are_left_out_withheld_ones_are_empty_and_later_ones_win(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in (("UPLINK", "topsecret"), ("PEBBLE_NOTIFY_FD", "3"), ("MARK", "inherited")):
        monkeypatch.setenv(name, value)
    withhold(["UPLINK", "NOT_SET"])
    variables = child_environment({"MARK": "first"}, {"MARK": "second"})
    assert (variables["MARK"], variables["UPLINK"], variables["PATH"]) == ("second", "", os.environ["PATH"])
    assert "PEBBLE_NOTIFY_FD" not in variables
    assert subprocess.run(["printenv", "UPLINK"], capture_output=True, check=True).stdout == b"\n"
    assert "NOT_SET" not in os.environ


#: The call that is refused, its error, and what is in the file after a write; or the reason that is given.
REFUSALS = {
    "no modes (FAT)": ("os.chmod", errno.EPERM, "new"),
    "no sync (SMB)": ("os.fsync", errno.EINVAL, "new"),
    "a disk that fails": ("os.fsync", errno.EIO, "Input/output error"),
    "a mount point": ("pathlib.Path.replace", errno.EBUSY, "new"),
    "another disk": ("pathlib.Path.replace", errno.EXDEV, "Invalid cross-device link"),
}


@pytest.mark.parametrize(("call", "number", "expected"), REFUSALS.values(), ids=REFUSALS)
def test_calls_that_a_file_system_lacks_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, number: int, expected: str
) -> None:
    file = tmp_path / "state"
    file.write_bytes(b"the old content")
    file.chmod(0o600)
    with monkeypatch.context() as patch:
        patch.setattr(call, refused(number))
        patch.setattr(os, "supports_fd", {*os.supports_fd, os.chmod})
        why = ""
        try:
            write(file, b"new", 0o600, PebbleError)
        except PebbleError as error:
            why = str(error).removeprefix(f"{file}: ")
    assert why or file.read_text() == expected
    assert [path.name for path in tmp_path.iterdir() if not why] in ([], ["state"])
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


@pytest.mark.parametrize("says", [refused(errno.EPERM), lambda: None], ids=["FAT", "SMB"])
def test_a_file_that_others_can_read_is_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any, says: Callable[[], None]
) -> None:
    def refuse(file: int, _mode: int) -> None:
        os.fchmod(file, 0o644)  # as all files have it there
        says()

    monkeypatch.setattr("os.chmod", refuse)
    monkeypatch.setattr(os, "supports_fd", {refuse})
    write(tmp_path / "state", b"new", 0o600, PebbleError)
    assert "state: others can read it, which cannot be changed here" in caplog.text


REFUSED = (
    *(f"{BASE}/incoming/{metric}" for metric in ("drive-values", "estop", "mcu/arm-1/move", "flags/reboot")),
    *(f"{BASE}/incoming/{metric}" for metric in ("by/otto/drive-values", "drive-values/", "/drive-values", "%2A")),
    *("arm/drive", "site/reboot", "site/@stop ?*", f"{BASE}/incoming", "a/b/c/incoming/drive-values"),
)
RAW = (f"{BASE}/incoming/+", f"{BASE}/incoming/#", "+/+/+/incoming/drive-values")  # of clients that are not ours
TAKEN = (
    *(f"{BASE}/outgoing/{metric}" for metric in ("online", "incoming/drive-values")),
    *(f"{BASE}/incoming/flags/{flag}" for flag in ("mqtt-video", "night", "reboot/now")),
    *("site/video", "will", f"a/{BASE}/incoming/drive-values"),
)


@pytest.fixture
def settings(tmp_path: Path) -> ZenohSettings:
    line = {"enabled": True, "serial": {"port": "/dev/ttyACM0"}, "topics": {"drive_values": "else/where"}}
    arm = {"serial": {"port": "/dev/ttyACM1"}, "topics": {"drive_values": "arm/drive", "lights_solid": "site/@stop ?*"}}
    services = {
        "serial_mcu_bridge": {**line, "instances": {"arm": arm}},
        "mqtt_bridge": {"topics": {"reboot": "site/reboot", "mqtt_video": "site/video"}},
    }
    transport = {"kind": "zenoh", "run_dir": str(tmp_path / "run"), "journal": str(tmp_path / "journal")}
    config = parse({"robot": {"id": "goob"}, "transport": transport, "services": services}, folder=tmp_path, env={})
    return hub_settings(config)


def die(settings: ZenohSettings, *topics: str) -> None:
    """Be killed as clients that have left a will on each of ``topics``."""
    client = ZenohSettings(run_dir=settings.run_dir, client=True)
    left = [Message(topic, b'{"z":0.6}', QoS.DELIVERED) for topic in topics]
    for victim in [ProcessPeer("zenoh", message.topic, client, message) for message in left]:
        victim.kill()  # it was connected: a hello succeeds, whatever the will


def test_by_topic(settings: ZenohSettings) -> None:
    admission = Admission((*WILLS, *settings.wills))
    assert [topic for topic in (*REFUSED, *RAW, *TAKEN) if admission.takes(topic)] == list(TAKEN)
    assert [topic for topic in TAKEN if not Admission(WILLS).takes(topic)] == [], "as a hub without a config"


def test_those_of_clients_that_are_killed_and_of_a_journal(settings: ZenohSettings) -> None:
    """An earlier hub of another version may have stored one that is refused now."""
    assert settings.journal is not None
    settings.run_dir.mkdir(mode=0o700)
    journal = Journal(settings.journal)
    journal.load()
    wills = {
        "a": Will("arm/drive", b'{"z":0.6}', QoS.DELIVERED, False, "a"),
        "b": Will("status", b"gone", QoS.DELIVERED, True),
    }
    journal.rewrite((name, msgspec.msgpack.encode(StoredWill(name, will))) for name, will in wills.items())
    journal.close()
    hub = HubProcess(settings.run_dir)
    hub.settings = settings
    hub.start()
    received: list[str] = []
    with create("zenoh", "watcher", ZenohSettings(run_dir=settings.run_dir, client=True)) as watcher:
        watcher.subscribe("#", lambda message: received.append(message.topic))
        assert until(lambda: received)
        die(settings, *REFUSED[:4], *TAKEN[:4])
        assert until(lambda: len(received) > 4)
        die(settings, "the/last")
        assert until(lambda: received[-1] == "the/last")
    assert sorted(received) == sorted((*TAKEN[:4], "status", "the/last"))
    _, printed = hub.end()
    assert printed.count("refused the will of") == 5
    assert b"arm/drive" not in b"".join(Journal(settings.journal).load())


class Asked:
    """A query; ``dropped``: it is answered with nothing."""

    def __init__(self, key: str, size: int) -> None:
        self.key_expr, self.payload, self.dropped = key, bytes(size), False

    def drop(self) -> None:
        self.dropped = True


def test_a_query_follows_each_task_and_too_large_a_hello_is_not_answered() -> None:
    intake, done = Intake(), list[str]()
    for number in range(3):
        asked: Any = Asked("@retain/**", 1)
        intake.ask(lambda _query, number=number: done.append(f"query {number}"), asked)  # type: ignore[misc]
        intake.put(partial(done.append, f"task {number}"))
    large: Any = Asked("@hub/hello/vera", ASKED_BYTES + 1)
    intake.greet(lambda _query: done.append("hello"), large)
    assert large.dropped
    intake.end()
    while (task := intake.take(0)) is not None:
        task()
    assert done == ["task 0", "query 0", "task 1", "query 1", "task 2", "query 2"]


@pytest.mark.parametrize(("waits_s", "works"), [(3.0, True), (0.0, False)])
def test_a_query_that_no_one_waits_for_any_more_is_not_answered(
    monkeypatch: pytest.MonkeyPatch, waits_s: float, works: bool
) -> None:
    monkeypatch.setattr(wire, "RETAINED_ANSWER_S", waits_s)
    intake = Intake()
    worked: list[Any] = []
    asked: Any = Asked("@retain/**", 1)
    intake.ask(worked.append, asked)
    task = intake.take(0)
    assert task is not None
    task()
    assert (asked.dropped, worked == [asked]) == (not works, works)


def test_beyond_the_room_eight_senders_wait_and_what_others_send_is_dropped(caplog: pytest.LogCaptureFixture) -> None:
    intake, done = Intake(), list[int]()
    intake.receive(partial(done.append, 0), QUEUE_BYTES + 1)
    senders = [
        threading.Thread(target=intake.receive, args=(partial(done.append, number), 1), daemon=True)
        for number in range(1, SENDERS + 3)
    ]
    for sender in senders:
        sender.start()
    assert until(lambda: intake.dropped == 2)
    assert "the hub receives more than it can store" in caplog.text
    for _ in range(SENDERS + 1):
        task = intake.take(5)
        assert task is not None
        task()
    assert len(done) == SENDERS + 1
    assert done[0] == 0


def test_each_client_is_logged_once_and_a_flood_of_them_not_without_end(caplog: pytest.LogCaptureFixture) -> None:
    admission = Admission(WILLS)
    will = Will(f"{BASE}/incoming/drive-values", b"{}", QoS.DELIVERED, False)
    for number in range(1000):
        admission.admitted(StoredWill("session", msgspec.structs.replace(will, client=f"evil-{number // 2}")))
    assert (admission.refused, len(caplog.records)) == (1000, 100)
    assert "evil-0" in caplog.messages[0]
    assert caplog.messages[-1].endswith("those of further clients are only counted")
