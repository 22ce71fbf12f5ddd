"""A broker that is meant for this machine alone. 127.0.0.2 stands for the machine's address on the network."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from pebble.check_result import State
from pebble.config import parse
from pebble.extensions.checks.broker.login import beyond_loopback, own_addresses
from pebble.extensions.checks.robot import run_checks
from pebble.transports.settings import MqttSettings
from tests.support import Broker, free_port, listening, until

OUTSIDE = "127.0.0.2"


#: Whether it also listens there, whether it asks for a login, and what is found.
PLACES = [
    (
        True,
        False,
        State.WARN,
        f"also answers at {OUTSIDE} and accepts anonymous logins: the network can drive the robot",
    ),
    (True, True, State.OK, f"also answers at {OUTSIDE}, and refuses anonymous logins there"),
    (False, False, State.OK, f"does not answer at {OUTSIDE}, ::1"),
]


@pytest.mark.parametrize(("elsewhere", "login", "state", "text"), PLACES)
def test_where_else_a_broker_answers(tmp_path: Path, elsewhere: bool, login: bool, state: State, text: str) -> None:
    port, passwords = free_port(), tmp_path / "passwords"
    subprocess.run(["mosquitto_passwd", "-b", "-c", str(passwords), "ann", "pw"], check=True, capture_output=True)
    options = ["allow_anonymous false", f"password_file {passwords}"] * login
    broker = Broker(tmp_path, *options, *[f"listener {port} {OUTSIDE}"] * elsewhere, port=port)
    assert until(lambda: listening(port, OUTSIDE) is elsewhere)  # it opens its listeners one after the other
    settings = MqttSettings(host="127.0.0.1", port=port)
    (found,) = beyond_loopback("local broker", settings, [OUTSIDE, "::1"])
    assert list(beyond_loopback("local broker", settings, [])) == []
    broker.stop()
    assert (found.state, text in found.text, found.what) == (state, True, f"local broker 127.0.0.1:{port}")
    assert found.fix.startswith(f"in mosquitto.conf: listener {port} 127.0.0.1") is (state is State.WARN)


def test_doctor_tries_the_addresses_of_this_machine(tmp_path: Path) -> None:
    broker = Broker(tmp_path)
    raw = {"robot": {"id": "fred"}, "local_mqtt": {"port": broker.port}}
    found = [finding.text for finding in run_checks(parse(raw, folder=tmp_path, env={}))]
    broker.stop()
    expected = [f"does not answer at {', '.join(own_addresses())}"] if own_addresses() else []
    assert [text for text in found if text.startswith("does not answer")] == expected
