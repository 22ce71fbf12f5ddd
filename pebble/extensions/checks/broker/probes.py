"""The table of probes of a broker, each with what robots lack if the broker fails it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from pebble.check_result import CheckResult, State, failed
from pebble.extensions.checks.broker import messages, retention
from pebble.extensions.checks.broker.peer import BrokerTrial, RefusedError
from pebble.extensions.checks.check import Check, run

Probe = Check[BrokerTrial]
_RIGHTS, _WILDCARDS, _BRIDGE_MODE = "rights", "retained, to + and #", "bridge mode"


def _probe(
    name: str, costs: str, test: Callable[[BrokerTrial], CheckResult], *needs: Callable[[BrokerTrial], str]
) -> Probe:
    """Return a check that runs with new connections and new topics."""

    def begin_and_test(trial: BrokerTrial) -> CheckResult:
        trial.begin()
        try:
            return test(trial)
        except RefusedError as error:
            return failed(f"a connection was refused: {error}", "let an account have ten connections at once")

    return Check(name, lambda trial: trial.judge(begin_and_test), needs, costs)


PROBES = (
    _probe(_RIGHTS, "nothing else can be tried", messages.rights),
    _probe("names of topics", "a robot with such a name is not heard, or loses its connection", messages.topics),
    _probe(
        "small messages",
        "boards and programs that confirm late are driven late; our own confirm at once",
        messages.delay,
    ),
    _probe("answers to pings", "a robot cannot tell how old a command is", messages.pings),
    _probe(
        "overlapping filters",
        "a program that does not merge its filters gets commands twice; ours do",
        messages.overlaps,
    ),
    _probe(
        _WILDCARDS,
        "operators see a robot at rest after its next state, or if they name it",
        retention.by_wildcard,
        retention.retains,
    ),
    _probe(
        "retained, before an answer to a ping",
        "a robot that comes back may send states once more; a flag may come twice",
        retention.before_pong,
        retention.retains,
    ),
    _probe("newest last", "other programs show an old value; ours drop it", retention.order, retention.retains),
    _probe(_BRIDGE_MODE, "own messages come back and are filtered by comparison; no mirror", messages.as_published),
    _probe(
        "will",
        "a robot that lost its power is shown as online until its heartbeat is overdue",
        messages.last_will,
    ),
    _probe(
        "refused subscriptions",
        "a robot that may not read its commands seems to be ready, and does not move",
        messages.refusals,
    ),
    _probe(
        "retained, after a restart",
        "running robots send their states again within 2 s; those of robots that are off, and flags, are lost",
        retention.restarted,
        retention.retains,
        retention.is_restarted,
    ),
)


def judge(trial: BrokerTrial) -> Iterator[tuple[Probe, CheckResult]]:
    """Run the probes in order, and yield their results; if the account lacks the rights, only the first."""
    for probe, result in run(PROBES, trial):
        yield probe, result
        if probe.name == _RIGHTS and result.state is State.FAILED:
            return


def assessment(states: Mapping[str, State]) -> list[str]:
    """Return what the results mean for robots, operators and a mirror, a sentence for each."""
    broken = [name for name, state in states.items() if state is State.FAILED]
    if broken:
        return [f"robots cannot use it with this account: {', '.join(broken)}"]
    limited = [name for name, state in states.items() if state is State.WARN]
    limits = f", with limits: {', '.join(limited)}" if limited else ""
    # How operators see a robot that sends nothing new, by the probe of retained messages, skipped if there are none.
    ways = {State.OK: "too", State.WARN: "after their next state, or by name", State.SKIPPED: "not at all"}
    at_rest = ways[states.get(_WILDCARDS, State.SKIPPED)]
    mirror = "can" if states.get(_BRIDGE_MODE) is State.OK else "cannot"
    return [f"robots can use it{limits}", f"operators see robots at rest {at_rest}", f"a mirror {mirror} use it"]
