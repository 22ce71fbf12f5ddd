"""What a robot's connections and the programs that it starts are set up with, and how its files are written."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import msgspec
import pytest

from pebble.config import parse
from pebble.contract import ESTOP
from pebble.errors import PebbleError
from pebble.extensions.fleet.gateway.connections import gateway_transports
from pebble.extensions.fleet.gateway.gateway import will
from pebble.extensions.fleet.gateway.gateway_file import GatewayFile
from pebble.runtime.connections import (
    local_settings,
    mqtt_settings,
    remote_transport,
    stops_transport,
)
from pebble.runtime.environment import child_environment, withhold
from pebble.runtime.whole_file import write
from pebble.transports import MqttSettings, create
from pebble.transports.hosts import SMALL_SEGMENT
from pebble.transports.topics import matches
from tests.sparing_broker import SparingBroker
from tests.support import Broker, refused, until

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


def test_a_file_that_others_can_read_is_logged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any) -> None:
    def refuse(file: int, _mode: int) -> None:
        os.fchmod(file, 0o644)  # as all files have it there
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr("os.chmod", refuse)
    monkeypatch.setattr(os, "supports_fd", {refuse})
    write(tmp_path / "state", b"new", 0o600, PebbleError)
    assert "state: others can read it, which cannot be changed here: Operation not permitted" in caplog.text
