"""Client ids: of what brokers take, different for every connection, or exactly what a config says."""

from __future__ import annotations

import json
import re
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pebble.config import Config, load
from pebble.extensions.checks.broker.login_attempt import attempt
from pebble.extensions.operator.client.connection import Target, resolve
from pebble.extensions.page.setting import settings_of
from pebble.runtime.connections import local_transport, mirror_transport, remote_transport
from pebble.transports import MqttSettings, State, create
from pebble.transports.mqtt.client_ids import unique
from tests.support import Broker, until


@pytest.mark.parametrize(
    ("name", "begins"),
    [
        ("pebble/robots/goob/remote_bridge", "pebble_robots_goob_remote_bridge-"),
        ("pebble-tool-7", "pebble-tool-7-"),
        ("a.b", "a_b-2e7336-"),
        ("a b", "a_b-c8687a-"),
        ("a_b", "a_b-"),
        ("pebble/robots/größe", "pebble_robots_gr__e-9ce5d0-"),
        ("日本", "__-cf2abf-"),
        ('a>b*c$#+\\"', "a_b_c_____"),
        ("\ud800", "_-"),
        ("", "-"),
    ],
)
def test_an_id_has_letters_digits_and_two_signs(name: str, begins: str) -> None:
    first, second = unique(name), unique(name)
    assert re.fullmatch(r"[A-Za-z0-9_-]*-[0-9a-f]{16}", first)
    assert first.startswith(begins)
    assert first[:-16] == second[:-16]
    assert first != second


class Robot:
    """A config whose brokers note the client ids that connect."""

    def __init__(self, folder: Path, client_id: str | None, robot: str = "go.ob") -> None:
        self._log = folder / "log"
        self.broker = Broker(folder, f"log_dest file {self._log}", "log_type notice")
        where = {"host": "127.0.0.1", "port": self.broker.port}
        given = {} if client_id is None else {"client_id": client_id}
        raw = {
            "robot": {"id": robot},
            "transport": {"kind": "mqtt", "run_dir": str(folder / "run"), "state_dir": str(folder / "state")},
            "local_mqtt": where,
            "services": {"mqtt_bridge": {"enabled": True, "remote_mqtt": {**where, **given}}},
        }
        self.file = folder / "robot.json"
        self.file.write_text(json.dumps(raw))
        self.config: Config = load(self.file)

    def ids(self) -> list[str]:
        return re.findall(r"New (?:client|bridge) connected from \S+ as (\S+) ", self._log.read_text())

    def connect_all(self) -> None:
        """Once each of what connects to a broker."""
        config, tool = self.config, Target(config=self.file, remote=True)
        tools: list[Any] = [resolve(replace(tool, program=one))[1] for one in ("estop", "drive", "tool")]
        made = [
            *(remote_transport(config, name) for name in ("remote-bridge", "camera-publisher", "audio-receiver")),
            *(create("mqtt", "pebble-tool", settings) for settings in (*tools, settings_of(config).broker)),
            *(make(config, "launcher") for make in (local_transport,)),
            mirror_transport(config, config.local_mqtt, "mqtt_mirror"),
        ]
        for transport in made:
            with closing(transport.open(10)):
                assert transport.state is State.CONNECTED
        assert attempt(tools[0], login=True).code == 0


def test_every_connection_of_a_robot_begins_with_its_name(tmp_path: Path) -> None:
    robot = Robot(tmp_path, None, "goob")
    robot.connect_all()
    own = [one for one in robot.ids() if not one.startswith(("pebble-tool-", "pebble-doctor-"))]
    assert [one[:-17] for one in own if one[0] == "p"] == [
        f"pebble_robots_goob_{name}"
        for name in ("remote_bridge", "camera_publisher", "audio_receiver", "launcher", "mqtt_mirror")
    ]
    assert len(set(robot.ids())) == len(robot.ids())
    robot.broker.stop()


def test_a_config_sets_the_id_of_the_bridge_and_how_the_others_begin(tmp_path: Path) -> None:
    robot = Robot(tmp_path, "thing:7/rover")
    robot.connect_all()
    fixed = ["", "-camera-publisher", "-audio-receiver", "-estop", "-drive", "-tool", "-web", "-estop"]
    assert [one for one in robot.ids() if one.startswith("thing")] == [f"thing:7/rover{end}" for end in fixed]
    robot.broker.stop()


@pytest.mark.parametrize("protocol", ["3.1.1", "5"])
def test_two_with_one_id_are_reported(tmp_path: Path, protocol: str) -> None:
    robot = Robot(tmp_path, "rover")
    settings = MqttSettings(host="127.0.0.1", port=robot.broker.port, client_id="rover", protocol=protocol)
    first, second = (create("mqtt", name, settings) for name in ("one", "two"))
    seen: list[str] = []
    first.on_state(lambda _state: seen.append(first.problem))
    with closing(first.open(10)), closing(second.open(0.0)):
        assert until(lambda: any('does another client use the client id "rover"?' in one for one in seen))
    robot.broker.stop()
