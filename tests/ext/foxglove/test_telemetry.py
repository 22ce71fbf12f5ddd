"""``pebble foxglove``: its errors, who may connect, and what robots publish besides pictures and sound."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.contract import (
    CHANNELS,
    CHARGING_LEVEL,
    IMU,
    LOGS,
    OUTGOING,
    STATUS,
    Channel,
)
from pebble.contract.payloads import (
    ChargingLevel,
    LogRecord,
)
from pebble.extensions.foxglove.json_channels import json_spec
from pebble.transports import Message, QoS, Transport
from tests.commands.command_line import Run, config_file
from tests.ext.foxglove.live import FRED, GOOB, Live, Watcher, client, live, online, publish
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


ONLINE, LEVEL = f"{GOOB}/outgoing/online", f"{GOOB}/outgoing/charging-level"


@pytest.fixture
def robot(broker: Broker) -> Iterator[Transport]:
    robot = client(broker)
    yield robot
    robot.close()


def test_each_value_has_its_schema_and_the_last_one_is_there_for_who_subscribes_later(
    broker: Broker, robot: Transport
) -> None:
    """The messages of Foxglove's schemas are tested where a recording is exported: they are the same."""
    publish(robot, GOOB, CHARGING_LEVEL, ChargingLevel(value=7.4))
    robot.publish(f"{GOOB}/outgoing/diagnostics", b"[1, 2]", retain=True)
    record = LogRecord(t=1_790_000_000_123, level="WARNING", service="bridge", message="careful")
    with live(broker) as server:
        first, second = Watcher(server.address), Watcher(server.address)
        first.subscribe(LEVEL)
        assert until(lambda: first.of(LEVEL)), "although it was published before"
        second.subscribe(LEVEL)
        assert until(lambda: second.of(LEVEL))
        first.subscribe(f"{GOOB}/outgoing/diagnostics")
        assert until(lambda: first.of(f"{GOOB}/outgoing/diagnostics") == [{"value": [1, 2]}])
        publish(robot, GOOB, LOGS, record)
        first.subscribe(f"{GOOB}/outgoing/logs/log")

        def logged() -> list[Any]:
            publish(robot, GOOB, LOGS, record)
            return first.of(f"{GOOB}/outgoing/logs/log")

        assert until(logged, step=0.05)
        log = logged()[0]
    channel = first.channels[LEVEL]
    assert (channel["encoding"], channel["schemaName"]) == ("json", "pebble.ChargingLevel")
    assert json.loads(channel["schema"])["properties"]["value"] == {"type": "number"}
    assert second.of(LEVEL)[0]["value"] == 7.4
    assert (log.level, log.name, log.message, log.timestamp.ToMilliseconds()) == (3, "bridge", "careful", record.t)


def test_a_robot_that_comes_later_gets_its_channels_then_and_one_that_goes_keeps_them(
    broker: Broker, robot: Transport
) -> None:
    online(robot, GOOB)
    with live(broker) as server:
        watcher = Watcher(server.address)
        watcher.subscribe(ONLINE)
        online(robot, FRED)
        watcher.subscribe(f"{FRED}/outgoing/online")
        assert until(lambda: watcher.of(f"{FRED}/outgoing/online"))
        robot.publish(ONLINE, b"", qos=QoS.DELIVERED, retain=True)  # it is removed from the broker
        online(robot, FRED, 2)
        assert until(lambda: {"t": 2} in watcher.of(f"{FRED}/outgoing/online"))
        later = Watcher(server.address)
        later.subscribe(ONLINE)
        assert until(lambda: later.of(ONLINE) == [{"t": 1}])
        online(robot, GOOB, 3)
        assert until(lambda: {"t": 3} in watcher.of(ONLINE))


def test_clients_only_look(broker: Broker, robot: Transport) -> None:
    received: list[Message] = []
    robot.subscribe(f"{GOOB}/incoming/#", received.append, direct=True)
    robot.publish(f"{GOOB}/outgoing/status", b"\xff\xfe", retain=True)
    robot.publish("pebble/servers/lab/outgoing/status", b'{"t": 1}', retain=True)
    online(robot, GOOB)
    drive = {"id": 1, "topic": f"{GOOB}/incoming/drive-values", "encoding": "json", "schemaName": "x"}
    with live(broker) as server:
        watcher = Watcher(server.address)
        assert until(lambda: watcher.info)
        assert watcher.info["capabilities"] == []
        watcher.send({"op": "advertise", "channels": [drive]})
        watcher.send(b"\x01\x01\x00\x00\x00" + b'{"x": 0, "z": 1}')
        assert until(lambda: watcher.statuses)
        assert "clientPublish" in watcher.statuses[0]["message"]
        watcher.subscribe(ONLINE)
        assert until(lambda: watcher.of(ONLINE))
        assert list(watcher.channels) == [ONLINE], "what is no JSON, and no robot's, is left out"
    assert received == []


def test_a_broker_that_goes_is_a_problem_in_foxglove_and_one_that_is_back_goes_on(
    broker: Broker, robot: Transport
) -> None:
    with live(broker) as server:
        watcher = Watcher(server.address)
        online(robot, GOOB)
        watcher.subscribe(ONLINE)
        assert until(lambda: watcher.of(ONLINE))
        broker.stop()
        assert until(lambda: watcher.statuses)
        assert f"mqtt://127.0.0.1:{broker.port}" in watcher.statuses[0]["message"]
        broker.start()

        def published() -> bool:
            online(robot, GOOB, 2)
            return {"t": 2} in watcher.of(ONLINE)

        assert until(published, step=0.1)


# -- the contract's schemas, in the part of JSON Schema that Foxglove reads

TELEMETRY = [channel for channel in CHANNELS if channel.direction == OUTGOING and channel.payload is not bytes]


def check(schema: dict[str, Any]) -> None:
    """Parses as foxglove/studio does (packages/mcap-support/src/parseJsonSchema.ts), which refuses everything else."""
    assert schema["type"] == "object"
    for field in schema["properties"].values():
        items = field["items"] if field["type"] == "array" else field
        assert items["type"] in ("boolean", "string", "number", "integer", "object")
        if items["type"] == "object":
            check(items)


@pytest.mark.parametrize("channel", TELEMETRY, ids=lambda channel: channel.suffix)
def test_foxglove_reads_every_schema(channel: Channel) -> None:
    spec = json_spec("topic", channel)
    assert (spec.encoding, spec.schema_encoding) == ("json", "jsonschema")
    check(json.loads(spec.schema or b'{"type": "object", "properties": {}}'))


def test_a_payload_that_no_schema_covers_may_be_any_json() -> None:
    assert json_spec("topic", STATUS)[2:] == ("pebble.Any", "jsonschema", b"")
    assert json_spec("topic", None)[2:] == ("pebble.Any", "jsonschema", b"")
    assert "orientation_deg" in json.loads(json_spec("topic", IMU).schema)["properties"]["value"]["properties"]
