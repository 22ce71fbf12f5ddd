"""A broker judged as a whole: as docs/brokers.md says, and without anything left behind."""

from __future__ import annotations

import json
import signal
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from pebble.check_result import CheckResult, State
from pebble.extensions.checks.broker.login_attempt import reached
from pebble.extensions.checks.broker.probes import judge
from pebble.transports import MqttSettings
from pebble.transports.mqtt.transport import MqttTransport
from tests.commands.command_line import Run, running
from tests.support import ROOT, WAIT_S, Broker, further, until
from tests.transports.brokers import MAKERS
from tests.transports.net import Received

DOCUMENT = ROOT / "docs" / "brokers.md"
MARKS = {State.OK: "yes", State.WARN: "limits", State.FAILED: "**no**", State.SKIPPED: "–"}
_RECOMMENDED = ("set_tcp_nodelay true",)


class Row(NamedTuple):
    """A broker that can run here. ``varies``: probes whose result differs from run to run."""

    make: Callable[[Path], Broker]
    missing: Callable[[], bool]
    varies: tuple[str, ...] = ()


BROKERS = {
    "mosquitto": Row(lambda folder: Broker(folder, *_RECOMMENDED, persistence=True), lambda: False),
    "mosquitto, plain": Row(Broker, lambda: False),
    "NATS": Row(MAKERS["nats"].make, MAKERS["nats"].missing, ("newest last",)),
    "RabbitMQ": Row(MAKERS["rabbitmq"].make, MAKERS["rabbitmq"].missing, ("newest last",)),
    "aedes": Row(MAKERS["aedes"].make, MAKERS["aedes"].missing),
}


def judged(row: Row) -> dict[str, CheckResult]:
    """By probe; the broker is restarted once."""
    with tempfile.TemporaryDirectory() as folder:
        broker = row.make(Path(folder))

        def restart() -> bool:
            broker.stop()
            broker.start()
            return True

        try:
            with reached(MqttSettings(host="127.0.0.1", port=broker.port), "pebble/doctor", restart) as trial:
                return {probe.name: result for probe, result in judge(trial)}
        finally:
            broker.stop()


def marks(findings: dict[str, CheckResult]) -> dict[str, str]:
    return {name: MARKS[finding.state] for name, finding in findings.items()}


def columns(text: str) -> dict[str, dict[str, str]]:
    """Return the marks in the first table of a document: by broker without its version, then by probe."""
    lines = text[text.index("\n| ") :].strip().partition("\n\n")[0].splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    names = [title.rpartition(" ")[0] for title in rows[0][1:]]
    return {name: {row[0]: row[place] for row in rows[2:]} for place, name in enumerate(names, 1)}


@pytest.mark.alone  # mosquitto's own delays are measured
@pytest.mark.thorough
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.skipif(row.missing(), reason=f"needs {name}: make long PART=brokers"))
        for name, row in BROKERS.items()
    ],
)
def test_the_document_has_what_is_found(name: str) -> None:
    row, documented = BROKERS[name], columns(DOCUMENT.read_text())[name]
    found = marks(judged(row))
    assert found == {**documented, **{probe: found[probe] for probe in row.varies}}


@pytest.mark.parametrize(
    ("lines", "code", "words"),
    [
        further([], 1, "robots can use it, with limits: small messages"),
        (["acl_file RULES"], 2, "robots cannot use it with this account: rights"),
    ],
)
def test_doctor_finds_whether_robots_can_use_a_broker(
    lines: list[str], code: int, words: str, tmp_path: Path, run: Run
) -> None:
    (tmp_path / "rules").write_text("topic read #\n")
    broker = Broker(tmp_path, *(line.replace("RULES", str(tmp_path / "rules")) for line in lines))
    assert run("doctor", "--broker", f"mqtt://127.0.0.1:{broker.port}", "--json") == code, run.out
    broker.stop()
    assert json.loads(run.out)["assessment"][0] == words


@pytest.mark.thorough
def test_what_it_retains_is_removed_when_it_is_interrupted(broker: Broker) -> None:
    settings, seen = MqttSettings(host="127.0.0.1", port=broker.port, as_published=True), Received()

    def retained() -> dict[str, bytes]:
        newest = {one.topic: one.payload for one in [*seen.messages] if one.retain_requested}
        return {topic: payload for topic, payload in newest.items() if payload}

    with MqttTransport("watcher", settings) as watcher:
        watcher.subscribe("pebble/doctor/#", seen, echo=False)
        with running("doctor", "--broker", f"mqtt://127.0.0.1:{broker.port}", stdout=subprocess.DEVNULL) as process:
            assert until(lambda: len(retained()) > 50, 60)
            process.send_signal(signal.SIGINT)
            assert process.wait(WAIT_S) == 130
        assert until(lambda: retained() == {})


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["doctor", "--broker", "mqtt://127.0.0.1:1"], "cannot be reached: Connection refused"),
        (["doctor", "--broker", "zenoh:/tmp"], "--broker must be mqtt://"),
        (["doctor", "--broker", "mqtt://ann:secret@broker.lab"], "--broker holds a password"),
        (["doctor", "--broker", "mqtt://broker.lab,spare.lab"], "--broker names one broker"),
        (["doctor", "--broker", "mqtt://127.0.0.1:PORT", "--below", "pebble/+"], "contains a wildcard"),
        (["doctor", "--broker", "mqtt://127.0.0.1:1", "robot.json"], "leave out the config file"),
    ],
)
def test_what_cannot_be_judged_is_one_clear_line(arguments: list[str], words: str, broker: Broker, run: Run) -> None:
    assert run(*(one.replace("PORT", str(broker.port)) for one in arguments), columns=200) != 0
    assert [words in line for line in (run.err or run.out).splitlines()][:1] == [True], run.out + run.err
