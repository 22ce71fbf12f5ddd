"""The promises of a transport (docs/transports.md, T1 to T21) that a broker decides, and whether one keeps them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from pebble.check_result import CheckResult, State
from pebble.doctor.broker.peer import Bench
from pebble.doctor.broker.probes import PROBES, RIGHTS, Probe, run
from pebble.selftest import failed, ok, skipped

PROMISES: Final = {
    "T1": "filters follow MQTT",
    "T2": "every allowed topic works",
    "T3": "what is delivered arrives, and in order",
    "T4": "nothing from before an outage arrives after it",
    "T5": "retained messages reach every later subscriber",
    "T6": "an empty message removes a retained one",
    "T7": "a live message tells whether it was to be retained",
    "T8": "no older value after a newer one",
    "T9": "retained messages survive a restart",
    "T10": "the will is published once",
    "T11": "overlapping filters, one message",
    "T12": "a lost connection is replaced",
    "T13": "handlers run one at a time",
    "T14": "a slow handler delays only itself",
    "T15": "payloads arrive unchanged",
    "T16": "own messages can be left out",
    "T17": "closing leaves nothing behind",
    "T18": "everything is counted",
    "T19": "a silent connection is replaced, and old commands are known",
    "T20": "what is on its way is known",
    "T21": "a refused subscription is known",
}


def judge(bench: Bench) -> Iterator[tuple[str, CheckResult, str]]:
    """Each promise, what came of it, and what that costs a robot; those that a broker does not decide come last."""
    left = {promise: [one for one in PROBES if promise in one.promises] for promise in PROMISES}
    found: dict[str, list[tuple[Probe, CheckResult]]] = {promise: [] for promise in PROMISES}
    without_rights = ""
    for probe, finding in run(bench):
        if probe is RIGHTS and finding.state is State.FAILED:
            without_rights = finding.text
        for promise in probe.promises:
            found[promise].append((probe, finding))
            if len(found[promise]) == len(left[promise]):
                yield promise, *_outcome(found[promise])
    if without_rights:
        yield RIGHTS.name, failed(without_rights, finding.fix), RIGHTS.costs
    for promise, probes in left.items():
        if not probes:
            yield promise, skipped("a broker does not decide it"), ""
        elif without_rights:
            yield promise, skipped("this account has no rights"), ""


def _outcome(found: list[tuple[Probe, CheckResult]]) -> tuple[CheckResult, str]:
    lacks = [(probe, one) for probe, one in found if one.state in (State.WARN, State.FAILED)]
    if lacks:
        text = "; ".join(f"{one.what}: {one.text}" for _, one in lacks)
        fix = "; ".join(dict.fromkeys(one.fix for _, one in lacks if one.fix))
        return failed(text, fix), "; ".join(probe.costs for probe, _ in lacks)
    if all(one.state is State.SKIPPED for _, one in found):
        return skipped(found[0][1].text), ""
    return ok("; ".join(f"{one.what}: {one.text}" for _, one in found if one.state is State.OK)), ""
