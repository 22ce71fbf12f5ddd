"""One of two brokers refuses a page, a tool or a robot: each says so, and goes on at the other one."""

from __future__ import annotations

import itertools
import json
import os
import re
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from pebble.checks.broker.account import robot_account
from pebble.checks.broker.of_config import page_brokers
from pebble.checks.check import State
from pebble.config import load
from pebble.fleet.broker_files import passwords_in
from pebble.fleet.certificates import CA_CERT
from pebble.fleet.folder import ACL, CONF, PASSWORDS
from pebble.fleet.roles import Account
from pebble.rig.processes import python
from pebble.runtime.every_host import EveryHost
from pebble.transports import Message, MqttSettings, QoS, TlsSettings, Transport, create
from pebble.transports import State as Link
from tests.fleet.brokers import HOST, FleetBroker
from tests.support import until
from tests.web.served import Page, RecordingRobot, Served

GOOB = "pebble/robots/goob"
ACCOUNTS = {
    "page": Account(roles=("page",)),
    "ann": Account(roles=("driver",)),
    "goob": Account(roles=("robot",), bases=(GOOB,)),
}
NUMBERS = itertools.count(1)


@pytest.fixture
def first(tmp_path: Path) -> FleetBroker:
    return FleetBroker(tmp_path / "first", ACCOUNTS)


@pytest.fixture
def second(first: FleetBroker, tmp_path: Path) -> Iterator[FleetBroker]:
    """It has the same accounts in a file of its own; both run."""
    with first.spare(tmp_path / "second") as spare, first:
        yield spare


def settings(name: str, *brokers: FleetBroker) -> MqttSettings:
    """Return those of all of them, with the login at the first."""
    own, places = brokers[0], tuple((HOST, one.port) for one in brokers)
    return MqttSettings(
        host=HOST,
        port=own.port,
        hosts=places if len(places) > 1 else (),
        username=name,
        password=own.passwords[name],
        tls=TlsSettings(ca_cert=own.folder / CA_CERT),
    )


def _remove(broker: FleetBroker, name: str) -> None:
    _change(broker, PASSWORDS, f"^{name}:.*\n")


def _take_rights(broker: FleetBroker, name: str) -> None:
    _change(broker, ACL, f"^user {name}\n(topic .*\n)*")


def _change(broker: FleetBroker, file: str, pattern: str) -> None:
    """Take lines out of a file that this broker reads."""
    text = (broker.folder / file).read_text()
    (broker.folder / file).write_text(re.sub(pattern, "", text, flags=re.MULTILINE))
    os.kill(broker.pid, signal.SIGHUP)


def _refuse_subscriptions(broker: FleetBroker, name: str) -> None:
    """Our own brokers grant all, and deliver what is allowed; one with this plugin refuses."""
    stored = passwords_in((broker.folder / PASSWORDS).read_text())
    clients = [
        {"username": one, "password": word.hash, "salt": word.salt, "iterations": word.iterations}
        for one, word in stored.items()
    ]
    access = {"publishClientSend": False, "publishClientReceive": False, "subscribe": False, "unsubscribe": True}
    file, conf = broker.folder / "plugin.json", broker.folder / CONF
    file.write_text(json.dumps({"defaultACLAccess": access, "clients": clients, "groups": [], "roles": []}))
    text = re.sub(r"^(acl|password)_file .*\n", "", conf.read_text(), flags=re.MULTILINE)
    plugin = next(Path("/usr/lib").glob("*/mosquitto_dynamic_security.so"))
    conf.write_text(f"plugin {plugin}\nplugin_opt_config_file {file}\n{text}")
    broker.stop()
    broker.start()


#: What a broker does, and how that is named.
REFUSALS: dict[str, tuple[Callable[[FleetBroker, str], None], str]] = {
    "account": (_remove, "refused us: not authorized"),
    "subscriptions": (_refuse_subscriptions, "it refuses to deliver +/+/+/outgoing/"),
    "rights": (_take_rights, "delivers nothing of what this account publishes"),
}


def _drives_and_stops(page: Page, robot: RecordingRobot) -> bool:
    number = next(NUMBERS)
    assert page.knows(GOOB, 10)
    assert page.take(GOOB)
    assert page.ready()
    driven = until(lambda: page.drive(GOOB, number, z=0.5) or any(one["z"] for one in robot.drives()), 5, step=0.05)
    page.send("estop", ref=GOOB, stop=f"{number:016x}", why="test")
    return driven and until(lambda: f"{GOOB}/incoming/estop" in robot.topics(), 3)


def _is_named(text: str, second: FleetBroker, why: str) -> bool:
    return text.startswith("messages come from only 1 of 2 brokers: ") and f":{second.port}" in text and why in text


@pytest.mark.parametrize("refusal", REFUSALS)
@pytest.mark.parametrize("running", [False, True], ids=["before", "while it runs"])
def test_a_page_names_the_broker_that_refuses_it(
    first: FleetBroker, second: FleetBroker, refusal: str, running: bool
) -> None:
    refuse, why = REFUSALS[refusal]
    login = settings("goob", first)
    with ExitStack() as stack:
        robot = stack.enter_context(
            RecordingRobot(first.port, GOOB, username="goob", password=login.password, tls=login.tls)
        )
        before = stack.enter_context(Served(first.port, broker=settings("page", first, second))) if running else None
        assert before is None or until(lambda: before.app.state.server.broker.not_received == "", 5)
        refuse(second, "page")
        served = before or stack.enter_context(Served(first.port, broker=settings("page", first, second)))
        page = stack.enter_context(served.page())
        assert until(lambda: _is_named(page.value("", "web/broker", "not_received") or "", second, why), 10), page.state
        assert _drives_and_stops(page, robot)


@pytest.mark.parametrize("refusal", ["account", "subscriptions"])
def test_a_tool_names_it(first: FleetBroker, second: FleetBroker, refusal: str, tmp_path: Path) -> None:
    refuse, why = REFUSALS[refusal]
    refuse(second, "ann")
    (tmp_path / "ann").write_text(first.passwords["ann"])
    url = f"mqtts://ann@{HOST}:{first.port},{HOST}:{second.port}"
    credentials = ["--password-file", str(tmp_path / "ann"), "--ca-cert", str(first.folder / CA_CERT)]
    command = python("pebble.cli", "topic", "list", "outgoing/online", "-s", "0.2", "--url", url, *credentials)
    shown = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False).stderr
    assert _is_named(shown.removeprefix("pebble: "), second, why.partition(" +")[0]), shown


@pytest.mark.parametrize("refusal", REFUSALS)
def test_the_doctor_names_it(first: FleetBroker, second: FleetBroker, refusal: str, tmp_path: Path) -> None:
    REFUSALS[refusal][0](second, "page")
    (tmp_path / "page").write_text(first.passwords["page"])
    mqtt = {"host": HOST, "port": second.port, "username": "page", "password_file": str(tmp_path / "page")}
    mqtt |= {"tls": {"enabled": True, "ca_cert": str(first.folder / CA_CERT)}}
    file = tmp_path / "page.json"
    file.write_text(json.dumps({"robot": {"id": "hall"}, "web_interface": {"mqtt": mqtt}}))
    failed = {one.what for one in page_brokers(load(file)) if one.state is State.FAILED}
    assert failed == {f"page's broker {HOST}:{second.port}"}


def test_a_certificate_that_is_not_trusted_is_named_too(first: FleetBroker, tmp_path: Path) -> None:
    with first, FleetBroker(tmp_path / "other", {}) as other, EveryHost("page", settings("page", first, other)) as page:
        assert until(lambda: _is_named(page.not_received, other, "certificate verify failed"), 5), page.not_received


@pytest.mark.parametrize("refusal", ["account", "subscriptions"])
def test_a_robot_uses_the_other_broker(first: FleetBroker, second: FleetBroker, refusal: str) -> None:
    """Also where it was let in and sent nothing; and if both do so, it stays."""
    REFUSALS[refusal][0](first, "goob")
    with create("mqtt", "robot", settings("goob", first, second)) as robot:
        got: list[Message] = []
        robot.subscribe(f"{GOOB}/incoming/#", got.append)
        assert until(lambda: robot.host == f"{HOST}:{second.port}" and not robot.not_received, 10), robot.problem
        with second.login("ann") as ann:
            ann.publish(f"{GOOB}/incoming/estop", b"{}")
            ann.flush()
        assert until(lambda: bool(got), 5)
        _refuse_subscriptions(second, "goob")
        robot.renew_connection("test")
        assert until(lambda: robot.state is Link.CONNECTED and bool(robot.not_received), 10), robot.problem


def test_a_robot_leaves_a_broker_that_takes_nothing_from_it(first: FleetBroker, second: FleetBroker) -> None:
    """Once: if both do so, it stays."""
    _take_rights(first, "goob")
    with create("mqtt", "robot", settings("goob", first, second)) as robot:
        robot.publish(f"{GOOB}/outgoing/status", b"{}", qos=QoS.DELIVERED, retain=True)
        assert until(lambda: robot.host == f"{HOST}:{second.port}", 20)
        _take_rights(second, "goob")
        assert until(lambda: _stays(robot), 60)


def _stays(robot: Transport) -> bool:
    """Whether it makes no new connection for longer than it takes to notice that nothing is taken."""
    before = robot.counters["connected"]
    return not until(lambda: robot.counters["connected"] > before, 5)


@pytest.mark.parametrize(("rules", "found"), [(True, State.OK), (False, State.FAILED)])
def test_the_doctor_of_a_robot_names_a_broker_without_rules(first: FleetBroker, *, rules: bool, found: State) -> None:
    if not rules:
        (first.folder / CONF).write_text((first.folder / CONF).read_text().replace("acl_file", "#"))
    with first:
        *_, last = robot_account("remote broker", settings("goob", first), GOOB, level="login")
        assert last.state is found, last.text
