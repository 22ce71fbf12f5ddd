"""Each promise that a broker breaks is found, and named: by settings of mosquitto, or by a fault before it."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pebble.check_result import CheckResult, State
from pebble.doctor.broker.judgement import reached
from pebble.doctor.broker.probes import PROBES
from pebble.fleet.roles import Account
from pebble.transports import MqttSettings, TlsSettings
from tests.brokers import faulty
from tests.brokers.faulty import Fault, FaultyBroker
from tests.fleet.brokers import FleetBroker
from tests.fleet.conftest import cheap_hashes as cheap_hashes
from tests.support import Broker, further

ALL = {probe.name: probe for probe in PROBES}
#: What needs more than a sound broker: an account, a restart, or the time of a keep-alive.
NEED_MORE = (
    "clients without a name",
    "refused subscriptions",
    "retained, after a restart",
    "will of a silent client",
)
BASIC = ("rights", "QoS 1", "retained messages")  # what the others build on

#: A line of mosquitto.conf, the probe that finds it, and words of what it tells.
SETTINGS = [
    ("set_tcp_nodelay false", "small messages", "holds them back"),
    ("retain_available false", "retained messages", "hangs up on them"),
    further("max_qos 0", "QoS 1", "hangs up on messages of QoS 1"),
    further("max_queued_messages 50", "a receiver that is behind", "of 500 messages"),
    further("message_size_limit 20000", "payloads", "does not carry 35 kB"),
    further("max_packet_size 20000", "payloads", "does not carry 35 kB"),
    further("message_size_limit 100000", "payloads", "35 kB and not 256 kB"),
]
#: Rules of mosquitto's acl_file.
RULES = [
    further("topic read #", "rights", State.FAILED, "may not publish"),
    further("topic write #", "rights", State.FAILED, "may not read"),
    further(
        "topic readwrite pebble/doctor/#",
        "refused subscriptions",
        State.SKIPPED,
        "may not publish there, or may not read",
    ),
    ("topic write #\ntopic readwrite pebble/doctor/#", "refused subscriptions", State.WARN, "then delivers nothing"),
]
#: A fault, the probe that finds it, and words of what it tells.
FAULTS = [
    further(faulty.DropsWills, "wills", "none is published"),
    further(faulty.LateWills, "wills", "s after the connection is reset"),
    (faulty.WillsAfterGoodbye, "no will after a goodbye", "is published as well"),
    further(faulty.Loses, "1,000 messages", "acknowledged and lost"),
    (faulty.Reorders, "1,000 messages", "out of order"),
    further(faulty.RetainsNothing, "retained messages", "retains none"),
    (faulty.HidesRetained, "retained messages", "without the retain flag"),
    further(faulty.AllRetained, "retained messages", "marked as retained"),
    further(faulty.Doubles, "overlapping filters", "2 copies"),
    (faulty.Changes, "payloads", "changes them"),
    (faulty.KeepsRemoved, "removal", "does not remove"),
    further(faulty.Mute, "answers to pings", "does not answer"),
    (faulty.EagerPongs, "answers to pings", "before it has passed on what came before"),
    (faulty.KeepsOld, "same client again", "stays open"),
    (faulty.Remembers, "nothing from an outage", "5 commands"),
    (faulty.SendsBack, "bridge mode", "own messages come back"),
    (faulty.WidensPlus, "filters", "also gets"),
]

PATIENCE_S = 1.5  # what does not come is waited for so long


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    broker = Broker(tmp_path_factory.mktemp("broker"), "set_tcp_nodelay true")
    yield broker
    broker.stop()


def found(port: int, name: str, restart: Callable[[], bool] | None = None) -> CheckResult:
    """The finding of one probe, after those that it builds on; nothing is left behind."""
    names = BASIC[: BASIC.index(name) + 1] if name in BASIC else (*BASIC, name)
    with reached(MqttSettings(host="127.0.0.1", port=port), "pebble/doctor", restart) as bench:
        bench.patience_s = PATIENCE_S
        *_, last = (ALL[one].finding(bench) for one in names)
    assert bench.left == []
    return last


@pytest.mark.parametrize(("line", "name", "words"), SETTINGS)
def test_what_a_setting_of_mosquitto_takes_away(line: str, name: str, words: str, tmp_path: Path) -> None:
    broker = Broker(tmp_path, line)
    finding = found(broker.port, name)
    broker.stop()
    assert (finding.state, words in finding.text) == (State.WARN, True), finding
    assert finding.fix.startswith("in mosquitto.conf: ")


@pytest.mark.parametrize(("rules", "name", "level", "words"), RULES)
def test_what_an_account_may_not_do(rules: str, name: str, level: State, words: str, tmp_path: Path) -> None:
    (tmp_path / "acl").write_text(f"{rules}\n")
    broker = Broker(tmp_path, f"acl_file {tmp_path / 'acl'}")
    finding = found(broker.port, name)
    broker.stop()
    assert (finding.state, words in finding.text) == (level, True), finding


@pytest.mark.parametrize(("fault", "name", "words"), FAULTS)
def test_a_fault_of_a_broker_is_found_and_named(fault: type[Fault], name: str, words: str, sound: Broker) -> None:
    with FaultyBroker(sound.port, fault) as broker:
        finding = found(broker.port, name)
    assert (finding.state in (State.WARN, State.FAILED), words in finding.text) == (True, True), finding


def test_a_sound_broker_passes(sound: Broker) -> None:
    with reached(MqttSettings(host="127.0.0.1", port=sound.port), "pebble/doctor") as bench:
        findings = [probe.finding(bench) for probe in PROBES if probe.name not in NEED_MORE]
    assert [one for one in findings if one.state is not State.OK] == []
    assert bench.left == []


@pytest.mark.parametrize(
    ("persistence", "steps", "level"),
    [
        (False, ("stop", "start"), State.WARN),
        further(True, ("stop", "start"), State.OK),
        (False, (), State.SKIPPED),  # a person pressed Enter, and did not restart it
    ],
)
def test_what_a_broker_forgets_at_a_restart_is_named(
    persistence: bool, steps: tuple[str, ...], level: State, tmp_path: Path
) -> None:
    broker = Broker(tmp_path, persistence=persistence)

    def restart() -> bool:
        for step in steps:
            getattr(broker, step)()
        return True

    finding = found(broker.port, "retained, after a restart", restart)
    broker.stop()
    assert finding.state is level, finding


def test_strangers_beside_an_account_are_named(tmp_path: Path) -> None:
    subprocess.run(["mosquitto_passwd", "-b", "-c", tmp_path / "passwords", "ann", "secret"], check=True)
    broker = Broker(tmp_path, f"password_file {tmp_path / 'passwords'}")
    settings = MqttSettings(host="127.0.0.1", port=broker.port, username="ann", password="secret")
    with reached(settings, "pebble/doctor") as bench:
        finding = ALL["clients without a name"].finding(bench)
    broker.stop()
    assert (finding.state, finding.text) == (State.WARN, "are let in, and read and publish what this account does")


@pytest.mark.parametrize(("account", "level"), [("admin", State.WARN), further("goob", State.OK)])
def test_an_account_that_changes_accounts_is_named(
    account: str, level: State, tmp_path: Path, cheap_hashes: None
) -> None:
    """At a broker as `pebble fleet init` makes it, with mosquitto's plugin; below the topics of a robot."""
    base = "pebble/robots/goob"
    with FleetBroker(tmp_path / "fleet", {"goob": Account(roles=("robot",), bases=(base,))}) as broker:
        place, word = broker.place, broker.passwords[account]
        tls = TlsSettings(ca_cert=place.ca)
        settings = MqttSettings(host=place.host, port=place.port, username=account, password=word, tls=tls)
        with reached(settings, base) as bench:
            assert ALL["accounts"].finding(bench).state is level
