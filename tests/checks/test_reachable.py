"""A broker that is meant for this machine alone. 127.0.0.2 stands for the machine's address on the network."""

from __future__ import annotations

import subprocess
from pathlib import Path

from pebble.checks.broker.reachable import beyond_loopback, own_addresses
from pebble.checks.check import CheckResult, State
from pebble.checks.robot import run_checks
from pebble.config import parse
from pebble.transports.settings import MqttSettings
from tests.support import Broker, free_port, listening, until

OUTSIDE = "127.0.0.2"


def with_another_listener(folder: Path, port: int, *options: str) -> Broker:
    """One that also answers OUTSIDE; mosquitto opens its listeners one after the other."""
    broker = Broker(folder, *options, f"listener {port} {OUTSIDE}", port=port)
    assert until(lambda: listening(port, OUTSIDE))
    return broker


def findings(broker: Broker) -> list[CheckResult]:
    return list(beyond_loopback("local broker", MqttSettings(host="127.0.0.1", port=broker.port), [OUTSIDE, "::1"]))


def test_a_broker_for_everybody_is_a_warning(tmp_path: Path) -> None:
    port = free_port()
    broker = with_another_listener(tmp_path, port)
    (found,) = findings(broker)
    broker.stop()
    assert (found.state, found.what) == (State.WARN, f"local broker 127.0.0.1:{port}")
    assert found.text == f"also answers at {OUTSIDE} and accepts anonymous logins: the network can drive the robot"
    assert found.fix.startswith(f"in mosquitto.conf: listener {port} 127.0.0.1")


def test_one_that_requires_a_login_is_named(tmp_path: Path) -> None:
    port, passwords = free_port(), tmp_path / "passwords"
    subprocess.run(["mosquitto_passwd", "-b", "-c", str(passwords), "ann", "pw"], check=True, capture_output=True)
    broker = with_another_listener(tmp_path, port, "allow_anonymous false", f"password_file {passwords}")
    (found,) = findings(broker)
    broker.stop()
    assert (found.state, found.text) == (State.OK, f"also answers at {OUTSIDE}, and refuses anonymous logins there")


def test_one_for_this_machine_alone_is_fine(tmp_path: Path) -> None:
    broker = Broker(tmp_path)
    (found,) = findings(broker)
    assert (found.state, found.text) == (State.OK, f"does not answer at {OUTSIDE}, ::1")
    assert list(beyond_loopback("local broker", MqttSettings(host="127.0.0.1", port=broker.port), [])) == []
    broker.stop()


def test_doctor_tries_the_addresses_of_this_machine(tmp_path: Path) -> None:
    broker = Broker(tmp_path)
    raw = {"robot": {"id": "fred"}, "local_mqtt": {"port": broker.port}}
    found = [finding.text for finding in run_checks(parse(raw, folder=tmp_path, env={}))]
    broker.stop()
    expected = [f"does not answer at {', '.join(own_addresses())}"] if own_addresses() else []
    assert [text for text in found if text.startswith("does not answer")] == expected
