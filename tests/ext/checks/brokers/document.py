"""Judges each broker that can run here, of which docs/brokers.md has a table."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from pebble.check_result import CheckResult, State
from pebble.extensions.checks.broker.login_attempt import reached
from pebble.extensions.checks.broker.probes import judge
from pebble.transports import MqttSettings
from tests.support import ROOT, Broker
from tests.transports.brokers import MAKERS

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
