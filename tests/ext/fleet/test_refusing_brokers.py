"""A broker that refuses a page, or lets everybody write: the doctor says so."""

from __future__ import annotations

import json
import os
import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pebble.check_result import State
from pebble.config import load
from pebble.extensions.checks.broker.account import robot_account
from pebble.extensions.checks.robot import page_brokers
from pebble.extensions.fleet.certificates import CA_CERT
from pebble.extensions.fleet.folder import ACL, CONF, PASSWORDS
from pebble.extensions.fleet.roles import Account
from pebble.transports import MqttSettings, TlsSettings
from tests.ext.fleet.brokers import HOST, FleetBroker

GOOB = "pebble/robots/goob"
ACCOUNTS = {
    "page": Account(roles=("page",)),
    "ann": Account(roles=("driver",)),
    "goob": Account(roles=("robot",), bases=(GOOB,)),
}


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[FleetBroker]:
    with FleetBroker(tmp_path / "fleet", ACCOUNTS) as running:
        yield running


def _remove(broker: FleetBroker, name: str) -> None:
    _change(broker, PASSWORDS, f"^{name}:.*\n")


def _take_rights(broker: FleetBroker, name: str) -> None:
    _change(broker, ACL, f"^user {name}\n(topic .*\n)*")


def _change(broker: FleetBroker, file: str, pattern: str) -> None:
    """Take lines out of a file that this broker reads."""
    text = (broker.folder / file).read_text()
    (broker.folder / file).write_text(re.sub(pattern, "", text, flags=re.MULTILINE))
    os.kill(broker.pid, signal.SIGHUP)


def _let(_broker: FleetBroker, _name: str) -> None:
    """The broker lets it in, and delivers."""


REFUSALS: dict[str, Callable[[FleetBroker, str], None]] = {
    "account": _remove,
    "rights": _take_rights,
}


@pytest.mark.parametrize("refusal", ["", *REFUSALS])
def test_the_doctor_names_a_broker_that_refuses_the_page(broker: FleetBroker, refusal: str, tmp_path: Path) -> None:
    REFUSALS.get(refusal, _let)(broker, "page")
    (tmp_path / "page").write_text(broker.passwords["page"])
    mqtt = {"host": HOST, "port": broker.port, "username": "page", "password_file": str(tmp_path / "page")}
    mqtt |= {"tls": {"enabled": True, "ca_cert": str(broker.folder / CA_CERT)}}
    file = tmp_path / "page.json"
    file.write_text(json.dumps({"robot": {"id": "hall"}, "web_interface": {"mqtt": mqtt}}))
    failed = {result.what for result in page_brokers(load(file)) if result.state is State.FAILED}
    assert failed == ({f"page's broker {HOST}:{broker.port}"} if refusal else set())


@pytest.mark.parametrize("rules", [True, False])
def test_the_doctor_of_a_robot_names_a_broker_without_rules(tmp_path: Path, *, rules: bool) -> None:
    broker = FleetBroker(tmp_path / "fleet", ACCOUNTS)
    if not rules:
        (broker.folder / CONF).write_text((broker.folder / CONF).read_text().replace("acl_file", "#"))
    tls = TlsSettings(ca_cert=broker.folder / CA_CERT)
    settings = MqttSettings(host=HOST, port=broker.port, username="goob", password=broker.passwords["goob"], tls=tls)
    with broker:
        found = [result.state for result in robot_account("remote broker", settings, GOOB, level="login")]
    assert found[0] is State.OK
    assert (State.FAILED in found) is not rules
