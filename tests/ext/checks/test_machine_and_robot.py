"""Each check finds its problem, and says what ends it."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import pytest

from pebble.check_result import CheckResult, State
from pebble.config import load, parse
from pebble.extensions.checks import machine, robot
from pebble.extensions.checks.broker import account, login
from pebble.extensions.checks.broker.account import robot_account
from pebble.extensions.checks.broker.login_attempt import LoginAttempt, attempt
from pebble.extensions.fleet.folder import ACL, CONF, PASSWORDS
from pebble.extensions.fleet.roles import Account
from pebble.transports.mqtt.ending import WANTS_TLS
from pebble.transports.settings import MqttSettings, TlsSettings
from tests.ext.fleet.brokers import HOST, FleetBroker
from tests.support import Broker, free_port, further, listening, until
from tests.tcp_proxy import ForbiddingProxy

FLEET = {
    "page": Account(roles=("page",)),
    "ann": Account(roles=("driver",)),
    "goob": Account(roles=("robot",), bases=("pebble/robots/goob",)),
}


# -- the machine


@pytest.mark.parametrize(
    ("now", "synchronised", "level"),
    [(0.0, True, State.FAILED), (1.8e9, True, State.OK), (1.8e9, None, State.OK), (1.8e9, False, State.WARN)],
)
def test_clock(now: float, synchronised: bool | None, level: State) -> None:
    finding = machine.clock(now, synchronised)
    assert finding.state is level
    assert bool(finding.fix) == (level is not State.OK)


@pytest.mark.parametrize(("script", "known"), [("echo yes", True), ("echo no", False), ("exit 1", None)])
def test_clock_synchronisation_by_systemd(
    script: str, known: bool | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tool = tmp_path / "timedatectl"
    tool.write_text(f"#!/bin/sh\n{script}\n")
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    assert machine.synchronised() is known


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


def test_a_broker_that_requires_a_login(tmp_path: Path) -> None:
    port = free_port()

    def found(username: str | None, password: str | None) -> list[CheckResult]:
        settings = MqttSettings(host=HOST, port=port, username=username, password=password)
        return list(login.broker("local broker", settings))

    with FleetBroker(tmp_path / "fleet", FLEET, unencrypted=port) as broker:
        right, wrong, none = found("ann", broker.passwords["ann"]), found("ann", "falsch"), found(None, None)
    assert [finding.state for finding in right] == [State.OK] * 3
    assert " ms" in right[0].text
    assert right[1].text == "refuses anonymous logins"
    assert wrong[0].state is State.FAILED
    assert wrong[0].text.startswith("refuses user ann: ")
    assert none[0].fix == "set username and password_file of this broker"
    assert "falsch" not in str(wrong)


PUBLISHES_NOTHING = "may not publish to pebble/robots/goob/outgoing/bridge-probe"
IS_DEAF = "may not read pebble/robots/goob/incoming/bridge-probe"
OWN = "readwrite +/+/+/outgoing/#\ntopic read +/+/+/incoming/#"


@pytest.mark.parametrize(
    ("protocol", "allowed", "max_qos", "level", "words"),
    [
        ("3.1.1", "readwrite #", 1, State.OK, "accepts"),
        further("5", "readwrite #", 1, State.OK, "accepts"),
        ("3.1.1", "read #", 1, State.FAILED, f"{PUBLISHES_NOTHING}: it does not come back"),
        ("5", "read #", 1, State.FAILED, f"{PUBLISHES_NOTHING}: the broker refuses it"),
        further("3.1.1", "write #", 1, State.FAILED, f"{PUBLISHES_NOTHING}: it does not come back"),
        ("5", "write #", 1, State.FAILED, IS_DEAF),
        further("3.1.1", OWN, 1, State.OK, "accepts"),
        ("5", OWN, 1, State.OK, "accepts"),
        ("3.1.1", "readwrite #", 0, State.WARN, "takes no QoS 1"),
        further("5", "readwrite #", 0, State.WARN, "takes no QoS 1"),
    ],
)
def test_an_account_that_may_not_publish_or_read_is_found(
    tmp_path: Path, protocol: str, allowed: str, max_qos: int, level: State, words: str
) -> None:
    (tmp_path / "acl").write_text(f"topic {allowed}\n")
    broker = Broker(tmp_path, f"acl_file {tmp_path / 'acl'}", f"max_qos {max_qos}")
    try:
        settings = MqttSettings(host="127.0.0.1", port=broker.port, protocol=protocol)
        finding = next(robot_account("b", settings, "pebble/robots/goob"))
    finally:
        broker.stop()
    assert finding.state is level
    assert words in finding.text


def test_a_broker_that_hangs_up_on_what_is_published_is_found(broker: Broker) -> None:
    with ForbiddingProxy(broker.port) as proxy:
        proxy.forbidden = {"pebble/robots/goob/outgoing/bridge-probe"}
        finding = next(robot_account("b", MqttSettings(host="127.0.0.1", port=proxy.port), "pebble/robots/goob"))
    assert (finding.state, "hangs up" in finding.text) == (State.FAILED, True)


@pytest.mark.parametrize(
    ("matters_s", "more"), [(account._MATTERS_S, []), (0.0, [("small messages at b", "are passed on at once")])]
)
def test_small_messages_are_judged_where_a_round_trip_matters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, matters_s: float, more: list[tuple[str, str]]
) -> None:
    monkeypatch.setattr(account, "_MATTERS_S", matters_s)
    broker = Broker(tmp_path, "set_tcp_nodelay true")
    settings = MqttSettings(host="127.0.0.1", port=broker.port)
    _, *found = [(result.what, result.text) for result in robot_account("b", settings, "pebble/robots/goob")]
    broker.stop()
    assert found == more


OUTSIDE = "127.0.0.2"  # stands for the machine's address on the network


#: Whether it also listens there, whether it asks for a login, and what is found.
PLACES = [
    (True, False, State.WARN, f"also answers at {OUTSIDE} and accepts anonymous logins: the network can drive"),
    (True, True, State.OK, f"also answers at {OUTSIDE}, and refuses anonymous logins there"),
    (False, False, State.OK, f"serves this machine only: nothing answers at {OUTSIDE}, ::1"),
]


@pytest.mark.parametrize(("elsewhere", "asks", "state", "text"), PLACES)
def test_where_else_a_broker_answers(tmp_path: Path, elsewhere: bool, asks: bool, state: State, text: str) -> None:
    port, passwords = free_port(), tmp_path / "passwords"
    subprocess.run(["mosquitto_passwd", "-b", "-c", str(passwords), "ann", "pw"], check=True, capture_output=True)
    options = ["allow_anonymous false", f"password_file {passwords}"] * asks
    broker = Broker(tmp_path, *options, *[f"listener {port} {OUTSIDE}"] * elsewhere, port=port)
    assert until(lambda: listening(port, OUTSIDE) is elsewhere)  # it opens its listeners one after the other
    settings = MqttSettings(host="127.0.0.1", port=port)
    (found,) = login.beyond_loopback("local broker", settings, [OUTSIDE, "::1"])
    assert list(login.beyond_loopback("local broker", settings, [])) == []
    broker.stop()
    assert (found.state, text in found.text, found.what) == (state, True, f"local broker 127.0.0.1:{port}")
    assert found.fix.startswith(f"in mosquitto.conf: listener {port} 127.0.0.1") is (state is State.WARN)


def valid_for(days: int) -> LoginAttempt:
    return LoginAttempt(code=0, expires=time.time() + days * 86400)


TLS, ANY_NAME, LET_IN = TlsSettings(), TlsSettings(insecure=True), LoginAttempt(code=0)
SHUT_OUT = LoginAttempt(code=5)
#: Its encryption, its answers to the login of the config and to an anonymous one, and what is found.
ELSEWHERE = [
    (None, LET_IN, LET_IN, ["ok", "warn", "warn"], "is not encrypted"),
    (None, LET_IN, SHUT_OUT, ["ok", "ok", "warn"], "is not encrypted"),
    (TLS, LET_IN, SHUT_OUT, ["ok", "ok", "ok"], "encrypted"),
    *((TLS, LET_IN, LoginAttempt(code=code), ["ok", "ok", "ok"], "encrypted") for code in (4, 134, 135)),
    *((TLS, LET_IN, LoginAttempt(code=code), ["ok", "warn", "ok"], "encrypted") for code in (3, 136)),
    (TLS, LET_IN, LoginAttempt(problem="timed out"), ["ok", "warn", "ok"], "encrypted"),
    (TLS, SHUT_OUT, SHUT_OUT, ["failed", "ok", "ok"], "pebble fleet password ann, or on the broker: sudo mosquitto_pa"),
    (TLS, LoginAttempt(code=3), SHUT_OUT, ["failed", "ok", "ok"], "its log says why"),
    *(
        (TLS, LoginAttempt(code=code), SHUT_OUT, ["failed", "ok", "ok"], "set remote_mqtt.client_id")
        for code in (2, 133)
    ),
    *((TLS, LoginAttempt(code=code), SHUT_OUT, ["failed", "ok", "ok"], "set protocol of") for code in (1, 132)),
    (ANY_NAME, LET_IN, SHUT_OUT, ["ok", "ok", "warn"], "set tls.insecure to false"),
    (TLS, valid_for(3), SHUT_OUT, ["ok", "ok", "warn"], "its certificate expires in 3 days"),
    (TLS, valid_for(15), SHUT_OUT, ["ok", "ok", "ok"], "encrypted, its certificate for 15 more days"),
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
    finding = findings[0 if states[0] == "failed" else -1]  # what the login is refused for, else the encryption
    assert words in f"{finding.text}; {finding.fix}"


def test_a_server_that_is_no_broker_is_a_problem() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        settings = MqttSettings(host="127.0.0.1", port=server.getsockname()[1])
        for protocol, sent in (("3.1.1", b"MQTT\x04"), ("5", b"MQTT\x05")):
            same = replace(settings, protocol=protocol)
            assert "does not answer" in attempt(same, login=True, timeout_s=0.2).problem
            with server.accept()[0] as connection:
                assert sent in connection.recv(100)
    wrong_file = MqttSettings(host="127.0.0.1", port=free_port(), tls=TlsSettings(ca_cert=Path("/nowhere/ca.pem")))
    assert attempt(wrong_file, login=True).problem != ""
    unknown = MqttSettings(host="ü" * 60, port=free_port())
    assert attempt(unknown, login=True).problem.endswith("is no name of a host")


#: Where a broker is that cannot be reached, whether this machine has mosquitto, and what to do.
UNREACHED = [
    ("127.0.0.1", "mosquitto", "refused", "sudo systemctl start mosquitto"),
    ("127.0.0.1", None, "refused", "sudo apt install mosquitto"),
    ("b.lab", None, "refused", "on b.lab: sudo systemctl start mosquitto; or correct the address b.lab:1"),
    ("b.lab", None, f"refused; {WANTS_TLS}", WANTS_TLS),
]


@pytest.mark.parametrize(("host", "mosquitto", "problem", "fix"), UNREACHED)
def test_a_broker_that_cannot_be_reached(
    host: str, mosquitto: str | None, problem: str, fix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(login, "attempt", lambda *_, **__: LoginAttempt(problem=problem))
    monkeypatch.setattr(login, "mosquitto_path", lambda: mosquitto)
    (finding,) = login.broker("b", MqttSettings(host=host, port=1))
    assert (finding.text, finding.fix) == ("cannot be reached: refused", fix)


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
    tried = {finding.text for finding in findings if "nothing answers at" in finding.text}
    assert tried == (
        {f"serves this machine only: nothing answers at {', '.join(login.own_addresses())}"}
        if login.own_addresses()
        else set()
    )
    assert [finding for finding in findings if finding.state is not State.OK and not finding.fix] == []


# -- brokers of a fleet

#: The file that the broker reads, and what is taken out of it.
REFUSALS = [("", ""), (PASSWORDS, "^page:.*\n"), (ACL, "^user page\n(topic .*\n)*")]


@pytest.mark.parametrize(("file", "lines"), REFUSALS, ids=("lets it in", "no account", "no rights"))
def test_a_broker_that_refuses_the_page_is_named(file: str, lines: str, tmp_path: Path) -> None:
    broker = FleetBroker(tmp_path / "fleet", FLEET)
    if file:
        text = (broker.folder / file).read_text()
        (broker.folder / file).write_text(re.sub(lines, "", text, flags=re.MULTILINE))
    (tmp_path / "page").write_text(broker.passwords["page"])
    mqtt = {"host": HOST, "port": broker.port, "username": "page", "password_file": str(tmp_path / "page")}
    mqtt |= {"tls": {"enabled": True, "ca_cert": str(broker.place.ca)}}
    raw = {"robot": {"id": "hall"}, "web_interface": {"mqtt": mqtt}}
    with broker:
        results = [*robot.page_brokers(parse(raw, folder=tmp_path, env={}))]
    failed = {result.what for result in results if result.state is State.FAILED}
    assert failed == ({f"page's broker {HOST}:{broker.port}"} if file else set())


@pytest.mark.parametrize("rules", [True, False])
def test_a_fleets_broker_is_judged_by_its_certificate_and_its_rules(tmp_path: Path, *, rules: bool) -> None:
    broker = FleetBroker(tmp_path / "fleet", FLEET)
    if not rules:
        (broker.folder / CONF).write_text((broker.folder / CONF).read_text().replace("acl_file", "#"))
    tls = TlsSettings(ca_cert=broker.place.ca)
    settings = MqttSettings(host=HOST, port=broker.port, username="goob", password=broker.passwords["goob"], tls=tls)
    with broker:
        texts = [one.text for one in login.broker("b", settings)]
        found = [result.state for result in robot_account("b", settings, "pebble/robots/goob", level="login")]
    assert texts[1:] == ["refuses anonymous logins", "encrypted, its certificate for 397 more days"]
    assert found[0] is State.OK
    assert (State.FAILED in found) is not rules


# -- who may drive

OPEN = "ok level open: it is driven by every program that reaches its broker, which here only this machine's do"
LOGIN = "ok level login: it is driven by every account of its broker with a role that drives; "
ROLES = {"ann": "driver", "otto": "viewer", "page-1": "page"}
FLEET_FILE = {
    "level": "login",
    "brokers": [{"host": "broker.lab", "port": 8883}],
    "accounts": {name: {"roles": [role]} for name, role in ROLES.items()},
}


#: The level, the fleet beside the config, and what is told: whole lines, or how they begin.
WHO_DRIVES = [
    ("open", json.dumps(FLEET_FILE), [OPEN]),
    (
        "login",
        json.dumps(FLEET_FILE),
        [LOGIN, "ok ann, page-1 (a page server: its people, too); programs on the robot itself, too"],
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
