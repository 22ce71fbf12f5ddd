"""The gate with real scripts, real sockets and a real mosquitto."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import paho.mqtt.client as paho
import pytest
from paho.mqtt.enums import CallbackAPIVersion

from pebble.config import load
from pebble.errors import PebbleError
from pebble.runtime.connections import local_transport
from pebble.services.autonomy_manager.gate.gate import Gate
from pebble.services.autonomy_manager.gate.server import GateServer
from pebble.transports import QoS
from tests.services.autonomy_manager.gate.mqtt_bytes import (
    BASE,
    CONNACK,
    DRIVE,
    PINGREQ,
    connect,
    packet,
    puback,
    publish,
    subscribe,
)
from tests.support import ROOT, Broker, Child, until

CERTS = ROOT / "tests" / "data" / "tls"
FOLLOW = ROOT / "tests" / "fakes" / "original_follow.py"
SUBACK, PINGRESP = b"\x90\x03\x00\x09\x00", b"\xd0\x00"


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    broker = Broker(tmp_path_factory.mktemp("broker"))
    yield broker
    broker.stop()


class Subscriber:
    """Receives what arrives on ``filter_`` at the robot's broker."""

    def __init__(self, port: int, filter_: str) -> None:
        self.messages: list[paho.MQTTMessage] = []
        subscribed = threading.Event()
        self._client = paho.Client(CallbackAPIVersion.VERSION2)
        self._client.on_connect = lambda client, *_: client.subscribe(filter_, 1)
        self._client.on_subscribe = lambda *_: subscribed.set()
        self._client.on_message = lambda _client, _data, message: self.messages.append(message)
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        assert subscribed.wait(10)

    @property
    def payloads(self) -> list[Any]:
        return [json.loads(message.payload) for message in self.messages]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.disconnect()
        self._client.loop_stop()


class Rig:
    """A robot with a broker, its manager's transport, and an open gate for run 7."""

    def __init__(self, broker: Broker, folder: Path, **changes: Any) -> None:
        self.file = folder / "goob.json"
        local = {"port": broker.port, **changes.pop("local_mqtt", {})}
        transport = {"kind": "mqtt", "run_dir": str(folder / "run"), "state_dir": str(folder / "state")}
        config = {"robot": {"id": "goob"}, "local_mqtt": local, "transport": transport, **changes}
        self.file.write_text(json.dumps(config))
        (folder / "camera_calibration.yaml").write_text("fx: 624")
        self.config = load(self.file)
        self.transport = local_transport(self.config, "autonomy_manager")
        self.transport.open(timeout=10)
        self.gate = Gate(self.config, self._publish, 7)
        self.gate.open()
        self._clients: list[socket.socket] = []
        self._processes: list[Child] = []

    def _publish(self, topic: str, payload: bytes) -> bool:
        return self.transport.publish(topic, payload, qos=QoS.DELIVERED, urgent=True)

    @property
    def local_mqtt(self) -> dict[str, Any]:
        return dict(json.loads(self.gate.config_path.read_text())["local_mqtt"])

    def connect(self) -> socket.socket:
        """A connection without login."""
        client = socket.create_connection(("127.0.0.1", self.local_mqtt["port"]), 10)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._clients.append(client)
        return client

    def log_in(self, **options: Any) -> socket.socket:
        client = self.connect()
        client.sendall(connect("script", self.local_mqtt["password"], **options))
        assert read(client, 4) == CONNACK
        return client

    def script(self, *options: str) -> Child:
        command = [sys.executable, str(FOLLOW), "--config", str(self.gate.config_path), *options]
        self._processes.append(Child(command))
        return self._processes[-1]

    def close(self) -> None:
        for process in self._processes:
            process.kill()
            process.wait(10)
        for client in self._clients:
            client.close()
        self.gate.close()
        self.transport.close()


Make = Callable[..., Rig]


@pytest.fixture
def make(broker: Broker, tmp_path: Path) -> Iterator[Make]:
    """Makes a robot at the shared broker, or at one with these options."""
    with ExitStack() as ends:

        def made(*options: str, **changes: Any) -> Rig:
            own = broker
            if options:
                own = Broker(tmp_path, *options)
                ends.callback(own.stop)
            rig = Rig(own, tmp_path, **changes)
            ends.callback(rig.close)
            return rig

        yield made


@pytest.fixture
def rig(make: Make) -> Rig:
    return make()


@pytest.fixture
def driven(broker: Broker) -> Iterator[Subscriber]:
    """What arrives on the drive topic."""
    with Subscriber(broker.port, DRIVE) as subscriber:
        yield subscriber


def read(client: socket.socket, size: int) -> bytes:
    """Exactly so many bytes; fewer if the connection ends."""
    data = b""
    while len(data) < size and (more := client.recv(size - len(data))):
        data += more
    return data


def ended(client: socket.socket) -> bool:
    """Read until the end; a reset is one, too."""
    try:
        while client.recv(65536):
            pass
    except ConnectionResetError:
        pass
    return True


def moves(drive: dict[str, Any]) -> bool:
    return any(drive.get(axis) for axis in "xyz")


@pytest.mark.parametrize("qos", [0, 2])
def test_all_commands_of_an_unchanged_script_are_signed(rig: Rig, broker: Broker, driven: Subscriber, qos: int) -> None:
    with Subscriber(broker.port, f"{BASE}/outgoing/apriltag-data") as found:
        rig.script("--control-rate-hz", "40", "--qos", str(qos), "--retain")
        assert until(lambda: len(driven.messages) >= 12)
        assert found.payloads[0]["detected"] is False, "everything else passes"
    assert {(drive["source"], drive["run"]) for drive in driven.payloads} == {("autonomy", 7)}
    assert not any(message.retain for message in driven.messages)
    with Subscriber(broker.port, DRIVE) as late:
        assert not any(message.retain for message in late.messages), "nothing is retained"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_wheels_stop_when_the_scripts_connection_ends(rig: Rig, driven: Subscriber, number: int) -> None:
    script = rig.script()
    assert until(lambda: any(map(moves, driven.payloads)))
    os.kill(script.pid, number)
    assert until(lambda: not moves(driven.payloads[-1]))
    assert driven.payloads[-1] == {"x": 0.0, "z": 0.0, "source": "autonomy", "run": 7}


def test_nothing_of_a_script_is_published_while_a_person_drives(rig: Rig, driven: Subscriber) -> None:
    rig.script("--control-rate-hz", "40")
    assert until(lambda: driven.messages)
    rig.gate.override(DRIVE, 0.5)
    swallowed, passed = rig.gate.counters["overridden"], len(driven.messages)
    assert until(lambda: rig.gate.counters["overridden"] > swallowed + 5, step=0.01)
    assert len(driven.messages) <= passed + 1, "one may have been on its way"
    assert until(lambda: len(driven.messages) > passed + 5), "it goes on afterwards"
    rig.gate.override(f"{BASE}/incoming/arm/drive-values", 60)
    before = len(driven.messages)
    assert until(lambda: len(driven.messages) > before + 5), "a person at another motor owner is no reason"


def test_a_script_receives_what_the_robot_publishes(rig: Rig, driven: Subscriber) -> None:
    corners = [[0.45, 0.4], [0.55, 0.4], [0.55, 0.533], [0.45, 0.533]]
    tag = {"marker_id": 13, "corners_norm": corners, "center_norm": [0.5, 0.4667]}
    locations = {"detections": [tag], "frame_width": 640, "frame_height": 480}
    rig.script("--control-rate-hz", "40")

    def follows() -> bool:
        rig.transport.publish(f"{BASE}/outgoing/apriltag-locations", json.dumps(locations).encode())
        return any(drive["z"] > 0.5 and drive["x"] == 0 for drive in driven.payloads)

    assert until(follows, step=0.05)


def test_what_passes_in_both_directions_is_noted(rig: Rig) -> None:
    noted: list[bool] = []
    rig.gate.activity.message = lambda: noted.append(True)  # type: ignore[method-assign]
    client = rig.log_in()
    client.sendall(subscribe(f"{BASE}/outgoing/touch-sensors") + PINGREQ)
    assert read(client, len(SUBACK) + len(PINGRESP)) == SUBACK + PINGRESP
    assert not noted, "a client that only pings is silent"
    rig.transport.publish(f"{BASE}/outgoing/touch-sensors", b"{}")
    assert until(lambda: len(noted) == 1)
    client.sendall(publish(f"{BASE}/outgoing/notes", "{}") + publish(DRIVE, "{}"))
    assert until(lambda: len(noted) >= 2), "its drive commands count as well"


def test_a_flood_is_limited_and_no_zero_is_lost(rig: Rig, driven: Subscriber) -> None:
    client, zeros, began = rig.log_in(), 0, time.monotonic()
    for number in range(300):
        client.sendall(publish(DRIVE, json.dumps({"z": 0.0 if number % 50 == 0 else 0.5, "number": number})))
        zeros += number % 50 == 0
        time.sleep(max(0.0, began + (number + 1) / 500 - time.monotonic()))
    assert until(lambda: driven.payloads[-1:] and driven.payloads[-1]["number"] == 299), "the newest one arrives"
    lasted = time.monotonic() - began
    moving = [drive for drive in driven.payloads if moves(drive)]
    assert [drive["number"] for drive in driven.payloads if not moves(drive)] == list(range(0, 300, 50))
    assert len(moving) <= 50 * lasted + 1
    numbers = [drive["number"] for drive in driven.payloads]
    assert numbers == sorted(numbers)


def test_fragments_and_batches(rig: Rig, driven: Subscriber) -> None:
    client = rig.log_in()
    for sent, answer in ((subscribe("answer"), SUBACK), (publish(DRIVE, '{"x":1}', 1, 5), puback(5))):
        for byte in sent:
            client.sendall(bytes((byte,)))
        assert read(client, len(answer)) == answer
    client.sendall(b"".join(publish("answer", f"{number}") for number in range(200)) + PINGREQ)
    expected = b"".join(publish("answer", f"{number}") for number in range(200)) + PINGRESP
    assert read(client, len(expected)) == expected
    assert until(lambda: driven.payloads)


@pytest.mark.parametrize(
    "sent", [b"GET / HTTP/1.1\r\n\r\n", b"\x00" * 100, b"\x10\xff\xff\xff\xff\xff", publish(DRIVE, "{}")]
)
def test_garbage_instead_of_a_login_ends_the_connection(rig: Rig, driven: Subscriber, sent: bytes) -> None:
    client = rig.connect()
    client.sendall(sent)
    assert ended(client)
    assert not driven.messages


def test_an_oversized_packet_ends_the_connection_and_stops_the_wheels(rig: Rig, driven: Subscriber) -> None:
    client = rig.log_in()
    client.sendall(publish(DRIVE, '{"z":1}') + packet(0x30, bytes(256 * 1024))[:100])
    assert ended(client)
    assert until(lambda: len(driven.messages) == 2)
    assert [drive["z"] for drive in driven.payloads] == [1, 0]
    client, large = rig.log_in(), publish("large", b"x" * 250_000)
    client.sendall(subscribe("large") + large)
    assert read(client, 5 + len(large)) == SUBACK + large, "another large one passes"


def test_a_client_that_does_not_read_delays_no_other(rig: Rig, driven: Subscriber) -> None:
    slow = rig.log_in()
    slow.sendall(subscribe("much"))
    assert read(slow, 5) == SUBACK
    for _ in range(60):
        rig.transport.publish("much", b"x" * 200_000)
    rig.log_in().sendall(publish(DRIVE, '{"z":0,"from":"other"}'))
    slow.sendall(publish(DRIVE, '{"z":0,"from":"slow"}'))
    assert until(lambda: {drive["from"] for drive in driven.payloads} == {"other", "slow"})


def test_a_client_of_mqtt_5_learns_why_it_is_refused(rig: Rig) -> None:
    reasons: list[Any] = []
    client = paho.Client(CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
    client.username_pw_set("script", rig.local_mqtt["password"])
    client.on_connect = lambda _client, _data, _flags, reason, _properties: reasons.append(reason)
    client.connect("127.0.0.1", rig.local_mqtt["port"])
    assert until(lambda: client.loop(0.05) is None or reasons)
    assert str(reasons[0]) == "Unsupported protocol version"


def test_the_17th_connection_is_refused(rig: Rig) -> None:
    clients = [rig.log_in() for _ in range(16)]
    assert not _accepted(rig)
    clients[0].sendall(PINGREQ)
    assert read(clients[0], 2) == PINGRESP
    clients[1].close()
    assert until(lambda: _accepted(rig))


def _accepted(rig: Rig) -> bool:
    client = rig.connect()
    try:
        client.sendall(connect("script", rig.local_mqtt["password"]))
        return read(client, 4) == CONNACK
    except ConnectionError:
        return False


def test_an_outage_of_the_broker_ends_connections_and_new_ones_work_after_it(tmp_path: Path) -> None:
    broker = Broker(tmp_path)
    rig = Rig(broker, tmp_path)
    client = rig.log_in()
    broker.kill()
    assert ended(client), "the script learns of it, and connects again"
    refused = rig.connect()
    refused.sendall(connect("script", rig.local_mqtt["password"]))
    assert read(refused, 100) == b"\x20\x02\x00\x03", "server unavailable"
    broker.start()
    client = rig.log_in()
    client.sendall(PINGREQ)
    assert read(client, 2) == PINGRESP
    rig.close()
    broker.stop()


def test_a_renamed_drive_topic_is_signed(broker: Broker, make: Make) -> None:
    serial = {"enabled": True, "serial": {"port": "/dev/none"}, "topics": {"drive_values": "my/wheels"}}
    with Subscriber(broker.port, "my/wheels") as driven:
        rig = make(services={"serial_mcu_bridge": serial})
        rig.log_in().sendall(publish("my/wheels", '{"value":{"z":1}}', retain=True))
        assert until(lambda: driven.payloads)
        assert driven.payloads == [{"value": {"z": 1, "source": "autonomy", "run": 7}}]
        assert not driven.messages[0].retain


def test_the_end_of_the_gate_stops_the_wheels_and_removes_the_config(rig: Rig, driven: Subscriber) -> None:
    client = rig.log_in()
    client.sendall(publish(DRIVE, '{"z":1}'))
    assert until(lambda: driven.payloads)
    rig.gate.close()
    assert ended(client)
    assert until(lambda: [drive["z"] for drive in driven.payloads] == [1, 0])
    assert not rig.gate.config_path.parent.exists()
    assert (rig.file.parent / "camera_calibration.yaml").exists(), "only links are removed"
    rig.gate.close()


def test_no_command_passes_once_halt_has_returned(
    rig: Rig, driven: Subscriber, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = rig.log_in()
    client.sendall(publish(DRIVE, '{"z":1}'))
    assert until(lambda: driven.messages)
    with monkeypatch.context() as patch:
        patch.setattr(GateServer, "post", lambda *_: None)  # its thread is late
        rig.gate.halt()
    rig.transport.publish(DRIVE, b'{"z":0,"halt":true}', qos=QoS.DELIVERED)
    for _ in range(5):
        client.sendall(publish(DRIVE, '{"z":1}'))
        time.sleep(0.021)
    client.sendall(publish(DRIVE, '{"z":0,"last":true}'))
    assert until(lambda: "last" in driven.payloads[-1])
    assert [drive["z"] for drive in driven.payloads] == [1, 0, 0]


def test_the_scripts_config_has_no_secret_and_its_files_beside_it(make: Make) -> None:
    remote = {"host": "far", "username": "goob", "password": "hunter2", "tls": {"enabled": True}}
    services = {
        "mqtt_bridge": {"remote_mqtt": remote, "media": {}},
        "av_daemon": {"video": {"width": 1280, "socket_path": "v.sock"}},
    }
    rig = make(services=services, local_mqtt={"username": "robot", "password": "hunter3"})
    shutil.rmtree(rig.gate.config_path.parent)  # as with a run directory that a logout removes
    text, path = rig.gate.config_path.read_text(), rig.gate.config_path
    assert "hunter" not in text
    services = json.loads(text)["services"]
    assert services["mqtt_bridge"]["remote_mqtt"]["host"] == "far"
    socket_path = str(rig.file.parent / "v.sock")
    assert services["av_daemon"] == {  # scripts would assume other sizes, and seek the socket elsewhere
        "video": {"width": 1280, "height": 480, "fps": 15, "rotate_degrees": 0, "socket_path": socket_path},
        "audio": {"rate": 16000, "channels": 1},
    }
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    assert (path.parent / "camera_calibration.yaml").read_text() == "fx: 624"
    assert load(path).transport.kind == "mqtt"
    assert rig.local_mqtt.keys() == {"host", "port", "username", "password"}


def test_the_broker_gets_the_robots_login(make: Make, tmp_path: Path) -> None:
    passwords = tmp_path / "passwords"
    subprocess.run(["mosquitto_passwd", "-b", "-c", passwords, "robot", "hunter3"], check=True)
    login = {"username": "robot", "password": "hunter3"}
    make("allow_anonymous false", f"password_file {passwords}", local_mqtt=login).log_in()


def test_the_robots_broker_may_want_tls(make: Make) -> None:
    files = [f"cafile {CERTS}/ca.crt", f"certfile {CERTS}/server.crt", f"keyfile {CERTS}/server.key"]
    own = {"ca_cert": "ca.crt", "client_cert": "client.crt", "client_key": "client.key"}
    tls = {"enabled": True, **{key: str(CERTS / name) for key, name in own.items()}}
    make(*files, "require_certificate true", local_mqtt={"host": "localhost", "tls": tls}).log_in().close()


def test_a_robot_without_a_broker_is_refused_with_what_to_set(tmp_path: Path) -> None:
    file = tmp_path / "goob.json"
    file.write_text(json.dumps({"robot": {"id": "goob"}, "transport": {"kind": "zenoh", "run_dir": str(tmp_path)}}))
    with pytest.raises(PebbleError, match=r"set transport\.mqtt_mirror"):
        Gate(load(file), lambda *_: True, 7)
