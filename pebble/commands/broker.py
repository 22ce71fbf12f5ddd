"""``--broker`` of ``pebble doctor`` and ``pebble conform``: judges a broker, and removes what it left there."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pebble.check_result import CheckResult, State
from pebble.client.url import FORMS, UrlError, settings_of
from pebble.commands.selftest import INDENT, ended, printed, row
from pebble.config.text_files import password
from pebble.runtime.signals import interrupted_by_signals
from pebble.transports import MqttSettings
from pebble.transports.topics import check_topic

if TYPE_CHECKING:
    from pebble.doctor.broker.peer import Bench

BELOW = "pebble/doctor"
_FORMS = "mqtt://[USER@]HOST[:PORT] or mqtts://[USER@]HOST[:PORT]"

BrokerOption = Annotated[
    str | None, typer.Option("--broker", help="Judge this broker instead: mqtt://[USER@]HOST[:PORT].", metavar="URL")
]
BelowOption = Annotated[
    str, typer.Option("--below", help="With --broker: topics below which the account may do all.", metavar="TOPIC")
]
RestartOption = Annotated[
    bool, typer.Option("--restart", help="With --broker: ask to restart it, and see what is still retained.")
]


def settings_at(url: str, password_file: Path | None, ca_cert: Path | None) -> MqttSettings:
    """Raises UrlError."""
    try:
        _, settings = settings_of(url, password=password(password_file), password_file=password_file, ca_cert=ca_cert)
    except UrlError as error:
        raise UrlError(str(error).replace("--url", "--broker").replace(FORMS, _FORMS)) from None
    if not isinstance(settings, MqttSettings):
        raise UrlError(f"--broker must be {_FORMS}")
    if settings.hosts:
        raise UrlError("--broker judges one broker: use one HOST[:PORT], and the command again for each further one")
    return settings


def doctor_of(
    settings: MqttSettings, below: str, *, restart: bool, as_json: bool, show: Callable[[CheckResult], None]
) -> int:
    """Print what is wrong with a broker, and what to type. Returns 0, 1 with limits, 2 if robots cannot use it."""
    from pebble.doctor.broker.judgement import assessment
    from pebble.doctor.broker.login import broker
    from pebble.doctor.broker.probes import run
    from pebble.doctor.broker.strangers import other_doors

    check_topic(below)
    found: list[tuple[CheckResult, str]] = []

    def note(finding: CheckResult, costs: str = "") -> State:
        costs = costs if finding.state in (State.WARN, State.FAILED) else ""
        found.append((finding, costs))
        if not as_json:
            show(finding)
            if costs:
                typer.echo(f"      costs: {costs}")
        return finding.state

    with interrupted_by_signals():
        doors = {finding.what: note(finding) for finding in broker("broker", settings)}
        levels: dict[str, State] = {what: level for what, level in doors.items() if level is State.FAILED}
        if not levels:
            for finding in other_doors("broker", settings):
                note(finding)
            with _left_as_it_was(settings, below, restart=restart) as bench:
                levels = {probe.name: note(finding, probe.costs) for probe, finding in run(bench)}
    words, counted = assessment(levels), [finding.state for finding, _ in found]
    code = 2 if State.FAILED in counted else int(State.WARN in counted)
    if as_json:
        rows = [{**row(one.what, one), "costs": costs} for one, costs in found]
        typer.echo(json.dumps({"ok": not code, "assessment": words, "checks": rows}, ensure_ascii=False))
        return code
    for line in words:
        typer.secho(line, bold=True)
    counts = {level: counted.count(level) for level in State}
    typer.echo(
        f"checks: {len(counted)}, warnings: {counts[State.WARN]}, failures: {counts[State.FAILED]}, "
        f"not tried: {counts[State.SKIPPED]}"
    )
    return code


def conform_of(settings: MqttSettings, below: str, *, restart: bool, as_json: bool) -> int:
    """Print which promises of a transport a broker keeps. Returns 1 if it does not keep one."""
    from pebble.conform.brokers import PROMISES, judge

    found: list[dict[str, str]] = []
    with interrupted_by_signals(), _left_as_it_was(settings, below, restart=restart) as bench:
        for promise, outcome, costs in judge(bench):
            name = f"{promise} {PROMISES.get(promise, '')}".strip()
            found.append({**row(name, outcome), "costs": costs})
            if not as_json:
                printed(found[-1])
                if costs:
                    typer.echo(f"{INDENT}costs: {costs}")
    return ended(found, as_json=as_json, broker=f"{settings.host}:{settings.port}")


@contextmanager
def _left_as_it_was(settings: MqttSettings, below: str, *, restart: bool) -> Iterator[Bench]:
    from pebble.doctor.broker.judgement import reached

    with reached(settings, below, _ask_to_restart if restart else None) as bench:
        yield bench
    if bench.left:
        more = f" and {len(bench.left) - 1} more" if bench.left[1:] else ""
        typer.echo(f"pebble: warning: still retained at the broker: {bench.left[0]}{more}", err=True)


def _ask_to_restart() -> bool:
    typer.echo(
        "Restart the broker now (sudo systemctl restart mosquitto), then press Enter; q to go without: ", err=True
    )
    return sys.stdin.readline().isspace()  # nothing at all: no person is there
