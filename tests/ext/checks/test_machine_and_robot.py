"""Each check finds its problem, with the command that fixes it."""

from __future__ import annotations

import json
import os
import resource
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.check_result import CheckResult, State
from pebble.config import load, parse
from pebble.extensions.checks import machine, robot
from pebble.extensions.checks.broker import login
from pebble.extensions.checks.broker.account import robot_account
from pebble.extensions.checks.broker.login_attempt import LoginAttempt, attempt
from pebble.transports.settings import MqttSettings, TlsSettings
from tests.ext.fleet.brokers import FleetBroker, accounts
from tests.support import Broker, free_port
from tests.tcp_proxy import ForbiddingProxy

MEGABYTE = 1024 * 1024


@pytest.fixture(scope="module")
def closed_broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    """Requires the login of ann, whose password is geheim."""
    folder = tmp_path_factory.mktemp("closed")
    subprocess.run(
        ["mosquitto_passwd", "-b", "-c", str(folder / "passwords"), "ann", "geheim"], check=True, capture_output=True
    )
    broker = Broker(folder, "allow_anonymous false", f"password_file {folder / 'passwords'}")
    yield broker
    broker.stop()


# -- the machine


def test_memory_lock() -> None:
    assert machine.memory_lock(resource.RLIM_INFINITY, root=False).state is State.OK
    assert machine.memory_lock(64 * MEGABYTE, root=False).state is State.OK
    assert machine.memory_lock(8 * MEGABYTE, root=True).state is State.OK
    low = machine.memory_lock(8 * MEGABYTE, root=False)
    assert low.state is State.WARN
    assert "8192 kB" in low.text
    assert "LimitMEMLOCK=infinity" in low.fix


@pytest.mark.parametrize(
    ("now", "synchronised", "level"),
    [(0.0, True, State.FAILED), (1.8e9, True, State.OK), (1.8e9, None, State.OK), (1.8e9, False, State.WARN)],
)
def test_clock(now: float, synchronised: bool | None, level: State) -> None:
    finding = machine.clock(now, synchronised)
    assert finding.state is level
    assert bool(finding.fix) == (level is not State.OK)


@pytest.mark.parametrize(
    ("script", "known"), [("echo yes", True), ("echo no", False), ("exit 1", None), ("echo Failed to connect", None)]
)
def test_clock_synchronisation_by_systemd(
    script: str, known: bool | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tool = tmp_path / "timedatectl"
    tool.write_text(f"#!/bin/sh\n{script}\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    assert machine.synchronised() is known
    monkeypatch.setenv("PATH", str(tmp_path / "empty"))
    assert machine.synchronised() is None


# -- the robot


def test_a_config_that_has_changed_since_the_start_is_found(tmp_path: Path) -> None:
    file, lock = tmp_path / "goob.json", tmp_path / "run" / "launcher.lock"
    lock.parent.mkdir()
    file.write_text(json.dumps({"robot": {"id": "goob"}, "transport": {"kind": "mqtt", "run_dir": str(lock.parent)}}))
    assert list(robot.config_of_running(load(file))) == []
    lock.write_text(f"{os.getpid()}\n")
    assert [found.state for found in robot.config_of_running(load(file))] == [State.OK]
    os.utime(lock, (1, 1))
    assert [found.state for found in robot.config_of_running(load(file))] == [State.WARN]


# -- brokers


def test_a_broker_that_requires_a_login(closed_broker: Broker) -> None:
    def found(username: str | None, password: str | None) -> list[CheckResult]:
        settings = MqttSettings(host="127.0.0.1", port=closed_broker.port, username=username, password=password)
        return list(login.broker("local broker", settings))

    right, wrong, none = found("ann", "geheim"), found("ann", "falsch"), found(None, None)
    assert [finding.state for finding in right] == [State.OK] * 3
    assert " ms" in right[0].text
    assert right[1].text == "refuses anonymous logins"
    assert wrong[0].state is State.FAILED
    assert wrong[0].text.startswith("refuses user ann: ")
    assert none[0].fix == "set username and password_file of this broker"
    assert "falsch" not in str(wrong)


def test_an_unreachable_broker_fails() -> None:
    port = free_port()
    finding, *more = login.broker("local broker", MqttSettings(host="127.0.0.1", port=port))
    assert more == []
    assert finding == CheckResult(
        State.FAILED,
        "cannot be reached: Connection refused",
        "sudo systemctl start mosquitto",
        f"local broker 127.0.0.1:{port}",
    )


@pytest.mark.parametrize("protocol", ["3.1.1", "5"])
@pytest.mark.parametrize(
    ("allowed", "level", "why"),
    [
        ("readwrite #", State.OK, "accepts what this account publishes"),
        ("read #", State.FAILED, "may not publish to pebble/robots/goob/outgoing/bridge-probe"),
        (
            "readwrite pebble/robots/other/#",
            State.FAILED,
            "may not publish to pebble/robots/goob/outgoing/bridge-probe",
        ),
    ],
)
def test_an_account_that_may_not_publish_is_found(
    tmp_path: Path, protocol: str, allowed: str, level: State, why: str
) -> None:
    (tmp_path / "acl").write_text(f"topic {allowed}\n")
    broker = Broker(tmp_path, f"acl_file {tmp_path / 'acl'}")
    try:
        settings = MqttSettings(host="127.0.0.1", port=broker.port, protocol=protocol)
        finding = next(robot_account("b", settings, "pebble/robots/goob"))
    finally:
        broker.stop()
    assert (finding.state, why in finding.text) == (level, True)
    assert level is State.OK or finding.fix == "allow it to write and read pebble/robots/goob/outgoing/# on the broker"


def test_a_broker_that_hangs_up_on_what_is_published_is_found(broker: Broker) -> None:
    with ForbiddingProxy(broker.port) as proxy:
        proxy.forbidden = {"pebble/robots/goob/outgoing/bridge-probe"}
        finding = next(robot_account("b", MqttSettings(host="127.0.0.1", port=proxy.port), "pebble/robots/goob"))
    assert (finding.state, "hangs up" in finding.text) == (State.FAILED, True)


def let_in(**answer: float) -> LoginAttempt:
    return LoginAttempt(code=0, **answer)


def valid_for(days: int) -> LoginAttempt:
    return let_in(expires=time.time() + days * 86400)


TLS, ANY_NAME = TlsSettings(), TlsSettings(insecure=True)
SHUT_OUT = LoginAttempt(code=5)
#: Its encryption, its answers to the login of the config and to an anonymous one, and what is found.
ELSEWHERE = [
    (None, let_in(), let_in(), ["ok", "warn", "warn"], "is not encrypted"),
    (None, let_in(), SHUT_OUT, ["ok", "ok", "warn"], "is not encrypted"),
    (TLS, let_in(), SHUT_OUT, ["ok", "ok", "ok"], "encrypted"),
    *((TLS, let_in(), LoginAttempt(code=code), ["ok", "ok", "ok"], "encrypted") for code in (4, 134, 135)),
    *((TLS, let_in(), LoginAttempt(code=code), ["ok", "warn", "ok"], "encrypted") for code in (1, 2, 3, 136, 151)),
    (TLS, let_in(), LoginAttempt(problem="timed out"), ["ok", "warn", "ok"], "encrypted"),
    (TLS, LoginAttempt(code=3), SHUT_OUT, ["failed", "ok", "ok"], "encrypted"),
    (ANY_NAME, let_in(), SHUT_OUT, ["ok", "ok", "warn"], "set tls.insecure to false"),
    (TLS, valid_for(3), SHUT_OUT, ["ok", "ok", "warn"], "its certificate expires in 3 days"),
    (TLS, valid_for(15), SHUT_OUT, ["ok", "ok", "ok"], "encrypted, its certificate for 15 more days"),
    (TLS, valid_for(397), SHUT_OUT, ["ok", "ok", "ok"], "encrypted, its certificate for 397 more days"),
]


@pytest.mark.parametrize(("tls", "own", "anonymous", "states", "words"), ELSEWHERE)
def test_a_broker_elsewhere(
    tls: TlsSettings | None,
    own: LoginAttempt,
    anonymous: LoginAttempt,
    states: list[str],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(login, "attempt", lambda _, *, login, timeout_s: own if login else anonymous)
    settings = MqttSettings(host="broker.example", username="ann", password="geheim", tls=tls)
    findings = list(login.broker("b", settings))
    assert [finding.state.value for finding in findings] == states
    assert words in f"{findings[-1].text}; {findings[-1].fix}"


def test_the_certificate_of_a_fleets_broker_is_read(tmp_path: Path) -> None:
    with FleetBroker(tmp_path / "hall", accounts(["viewer"])) as hall:
        tls = TlsSettings(ca_cert=hall.place.ca)
        settings = MqttSettings(
            host="127.0.0.1", port=hall.port, username="viewer", password=hall.passwords["viewer"], tls=tls
        )
        texts = [one.text for one in login.broker("b", settings)]
    assert texts[1:] == ["refuses anonymous logins", "encrypted, its certificate for 397 more days"]


def test_a_server_that_is_no_broker_is_a_problem() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        settings = MqttSettings(host="127.0.0.1", port=server.getsockname()[1])
        assert "does not answer" in attempt(settings, login=True, timeout_s=0.2).problem
    wrong_file = MqttSettings(host="127.0.0.1", port=free_port(), tls=TlsSettings(ca_cert=Path("/nowhere/ca.pem")))
    assert attempt(wrong_file, login=True).problem != ""
    unknown = MqttSettings(host="ü" * 60, port=free_port())
    assert attempt(unknown, login=True).problem.endswith("is no name of a host")


@pytest.mark.parametrize(
    ("web", "level", "text"),
    [
        ({"mqtt": {"host": "127.0.0.1"}}, State.OK, "port 8080 of 127.0.0.1"),
        ({}, State.FAILED, "web_interface.mqtt.host: is missing"),
        ({"mqtt": {"host": "b"}, "host": "0.0.0.0"}, State.FAILED, "`pebble cert init` and `pebble web user add`"),
        ({"mqtt": {"host": "b"}, "host": "0.0.0.0", "plain_http": True}, State.WARN, "is not encrypted"),
    ],
)
def test_the_operator_page_of_a_robot(web: dict[str, object], level: State, text: str) -> None:
    raw = {"robot": {"id": "goob"}, "services": {"web_handler": {"enabled": True}}, "web_interface": web}
    (finding,) = robot.operator_page(parse(raw, folder=Path("/nowhere"), env={}))
    assert (finding.state, text in finding.text) == (level, True)


def test_a_whole_robot_is_examined(tmp_path: Path, broker: Broker) -> None:
    path = tmp_path / "fred.json"
    bridge = {"enabled": True, "remote_mqtt": {"host": "127.0.0.1", "port": free_port()}}
    serial = {"enabled": True, "serial": {"port": str(tmp_path / "ttyACM0")}}
    text = {
        "robot": {"id": "fred"},
        "local_mqtt": {"port": broker.port},
        "services": {"mqtt_bridge": bridge, "serial_mcu_bridge": serial},
    }
    path.write_text(json.dumps(text))
    findings = list(robot.run_checks(load(path)))
    failed = [finding.what.split(" ")[0] for finding in findings if finding.state is State.FAILED]
    assert failed == ["serial", "remote"]
    assert {"memory lock", "clock", "state directory"} <= {finding.what for finding in findings}
    assert [finding for finding in findings if finding.state is not State.OK and not finding.fix] == []


# -- who may drive

OPEN = "ok level open: it is driven by every program that reaches its broker, which here only this machine's do"
LOGIN = (
    "ok level login: it is driven by every account of its broker with a role that drives; "
    "which one sent a command is not checked"
)


def fleet_of(roles: dict[str, str]) -> str:
    accounts = {name: {"roles": [role]} for name, role in roles.items()}
    return json.dumps({"level": "login", "brokers": [{"host": "broker.lab", "port": 8883}], "accounts": accounts})


#: The level, the fleet beside the config, and what is told: whole lines, or how they begin.
WHO_DRIVES = [
    ("open", fleet_of({}), [OPEN]),
    (
        "login",
        fleet_of({"ann": "driver", "otto": "viewer", "page-1": "page"}),
        [LOGIN, "ok ann, page-1 (a page server: its people, too); programs on the robot itself, too"],
    ),
    (
        "login",
        fleet_of({f"p{n}": "driver" for n in range(20)}),
        [LOGIN, f"ok {', '.join(f'p{n}' for n in range(12))}, and 8 more; programs on the robot itself, too"],
    ),
    ("login", "{", [LOGIN, "warn fleet.json"]),
]


@pytest.mark.parametrize(("level", "fleet", "expected"), WHO_DRIVES)
def test_who_can_drive_is_shown_by_the_level_and_by_the_fleet_beside_the_config(
    tmp_path: Path, level: str, fleet: str, expected: list[str]
) -> None:
    config = tmp_path / "goob.json"
    config.write_text(json.dumps({"robot": {"id": "goob"}, "security": {"level": level}}))
    (tmp_path / "fleet.json").write_text(fleet)
    lines = [
        f"{result.state.value} {result.text}".replace(f"{tmp_path}/", "") for result in robot.who_drives(load(config))
    ]
    assert len(lines) == len(expected)
    assert [line[: len(words)] for line, words in zip(lines, expected, strict=True)] == expected
