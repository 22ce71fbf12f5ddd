"""Each promise that a broker breaks is found, and named: by settings of mosquitto, or by a fault before it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pebble.check_result import CheckResult, State
from pebble.extensions.checks.broker.login_attempt import reached
from pebble.extensions.checks.broker.probes import PROBES, Probe
from pebble.extensions.checks.check import run
from pebble.transports import MqttSettings
from tests.ext.checks.brokers import faulty
from tests.ext.checks.brokers.faulty import Fault, FaultyBroker
from tests.support import Broker, further

RIGHTS, *OTHERS = PROBES
#: What needs more than a sound broker: an account, or a restart.
NEED_MORE = ("refused subscriptions", "retained, after a restart")

#: A line of mosquitto.conf, or rules of its acl_file, the probe that finds it, and words of what it tells.
SETTINGS = [
    ("set_tcp_nodelay false", "small messages", State.WARN, "holds them back"),
    ("retain_available false", "rights", State.WARN, "it retains nothing"),
    further("max_qos 0", "rights", State.WARN, "it has no QoS 1"),
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
    (faulty.DropsWills, "will", "none is published"),
    further(faulty.LateWills, "will", "s after the connection is reset"),
    further(faulty.RetainsNothing, "rights", "it retains nothing"),
    (faulty.HidesRetained, "rights", "without the retain flag"),
    (faulty.Doubles, "overlapping filters", "2 copies"),
    (faulty.Floods, "rights", "without end"),
    further(faulty.Mute, "answers to pings", "does not answer"),
    (faulty.EagerPongs, "answers to pings", "before it has passed on what came before"),
    (faulty.SendsBack, "bridge mode", "own messages come back"),
]

PATIENCE_S = 1.5  # what does not come is waited for so long


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    broker = Broker(tmp_path_factory.mktemp("broker"), "set_tcp_nodelay true")
    yield broker
    broker.stop()


def found(port: int, name: str, restart: Callable[[], bool] | None = None) -> CheckResult:
    """The result of one probe, after the first, on which all build; nothing is left behind."""
    probes: list[Probe] = [RIGHTS, *(probe for probe in OTHERS if probe.name == name)]
    with reached(MqttSettings(host="127.0.0.1", port=port), "pebble/doctor", restart) as trial:
        trial.patience_s = PATIENCE_S
        *_, (_, last) = run(probes, trial)
    assert list(trial.left) == []
    return last


@pytest.mark.parametrize(("lines", "name", "level", "words"), SETTINGS)
def test_what_settings_and_rules_of_mosquitto_take_away(
    lines: str, name: str, level: State, words: str, tmp_path: Path
) -> None:
    (tmp_path / "acl").write_text(f"{lines}\n")
    are_rules = lines.startswith("topic ")
    broker = Broker(tmp_path, f"acl_file {tmp_path / 'acl'}" if are_rules else lines)
    finding = found(broker.port, name)
    broker.stop()
    assert (finding.state, words in finding.text) == (level, True), finding
    assert are_rules or finding.fix.startswith("in mosquitto.conf: ")


@pytest.mark.parametrize(("fault", "name", "words"), FAULTS)
def test_a_fault_of_a_broker_is_found_and_named(fault: type[Fault], name: str, words: str, sound: Broker) -> None:
    with FaultyBroker(sound.port, fault) as broker:
        finding = found(broker.port, name)
    assert (finding.state in (State.WARN, State.FAILED), words in finding.text) == (True, True), finding


def test_a_sound_broker_passes(sound: Broker) -> None:
    with reached(MqttSettings(host="127.0.0.1", port=sound.port), "pebble/doctor") as trial:
        results = [result for probe, result in run(PROBES, trial) if probe.name not in NEED_MORE]
    assert [result for result in results if result.state is not State.OK] == []
    assert list(trial.left) == []


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
