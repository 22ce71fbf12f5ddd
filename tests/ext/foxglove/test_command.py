"""``pebble foxglove``: its errors, its one robot of a config, and who may connect."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.commands.command_line import Run, config_file
from tests.ext.foxglove.live import FRED, GOOB, Live, Watcher, client, online
from tests.support import Broker, until


def test_which_robots_are_shown_has_to_be_named(run: Run, tmp_path: Path) -> None:
    assert run("foxglove") == 1
    assert run.err == ("pebble: which robots is missing: name either a robot's config file or --url mqtt://BROKER\n")
    assert run("foxglove", config_file(tmp_path)) == 1
    assert run.err.startswith("pebble: services.mqtt_bridge.remote_mqtt.host: is not set")
    assert run("foxglove", "--url", f"zenoh:{tmp_path}") == 1
    assert run.err == "pebble: Foxglove needs the robots' broker: use --url mqtt://HOST[:PORT] or mqtts://…\n"


def test_without_its_packages_one_line_names_the_extra(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove_schemas_protobuf.RawAudio_pb2", None)
    assert run("foxglove", "--url", "mqtt://127.0.0.1") == 1
    assert 'pip install "pebble-robot[foxglove]"' in run.err
    assert run.err.count("\n") == 1


def test_other_machines_are_let_in_only_with_two_options(run: Run, broker: Broker) -> None:
    url = f"mqtt://127.0.0.1:{broker.port}"
    assert run("foxglove", "--url", url, "--host", "0.0.0.0") == 1
    assert run.err.startswith("pebble: --host 0.0.0.0: other machines could watch and listen without a login")
    assert run.err.rstrip().endswith("add --no-login")
    server = Live(broker, "--host", "0.0.0.0", "--no-login")
    _, errors = server.end()
    assert "everybody on the network can watch and listen, without a login and unencrypted" in errors


def test_a_config_shows_its_robot_at_its_remote_broker(tmp_path: Path, broker: Broker) -> None:
    remote = {"mqtt_bridge": {"remote_mqtt": {"host": "127.0.0.1", "port": broker.port}}}
    config = config_file(tmp_path, services=remote)
    robot = client(broker)
    server = Live(str(config))
    watcher = Watcher(server.address)
    for base in (FRED, GOOB):
        online(robot, base)
    watcher.subscribe(f"{GOOB}/outgoing/online")
    assert until(lambda: watcher.of(f"{GOOB}/outgoing/online"))
    assert list(watcher.channels) == [f"{GOOB}/outgoing/online"]
    server.end()
    robot.close()
