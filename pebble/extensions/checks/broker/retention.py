"""Probes of a broker's retained messages: which it keeps, which subscriptions get them, and in which order."""

from __future__ import annotations

from pebble.check_result import CheckResult, failed, ok, skipped, warn
from pebble.extensions.checks.broker import MOSQUITTO, OTHER
from pebble.extensions.checks.broker.peer import BrokerTrial, Peer, RefusedError

_STATES = 200  # retained ones; a robot has some twenty
_TRIES = 6  # to get the retained message after a restart, each for a third of the time for an answer
_MOST_FILTERS = 8  # filters in one SUBSCRIBE: AWS IoT closes the connection for more
_PERSISTENT = f"{MOSQUITTO}persistence true, persistence_location /var/lib/mosquitto/, autosave_on_changes true"


def retains(trial: BrokerTrial) -> str:
    return "" if trial.retains else "it retains nothing"


def is_restarted(trial: BrokerTrial) -> str:
    return "" if trial.restart is not None else "it was not restarted: --restart asks for that"


def _retain_states(trial: BrokerTrial) -> list[str]:
    names, writer = [f"s/{place}" for place in range(_STATES)], trial.peer()
    for name in names:
        writer.publish(name, qos=0, retain=True)
    writer.ping()
    return names


def by_wildcard(trial: BrokerTrial) -> CheckResult:
    """Check that a subscription with a wildcard gets all retained messages: the worse of two filters counts."""
    names = set(_retain_states(trial))
    counts = []
    for filter_ in ("s/+", "#"):
        reader = trial.peer()
        reader.subscribe(filter_, qos=0)
        trial.wait(lambda: len(reader.topics()) == len(names) or reader.closed)  # noqa: B023
        counts.append(len(reader.topics() & names))
    fewest = min(counts)
    trial.wildcards = fewest > 0
    if not fewest:
        return warn("nothing comes: only subscriptions of exact names get retained messages")
    if fewest < len(names):
        return failed(f"{fewest} of {len(names)} come", f"{MOSQUITTO}max_queued_messages 1000")
    return ok(f"all {len(names)}")


def before_pong(trial: BrokerTrial) -> CheckResult:
    """Check that retained messages come before the answer to a ping that was sent after the subscription."""
    names, reader = _retain_states(trial), trial.peer()
    expected = len(names) if trial.wildcards else _MOST_FILTERS
    filters = ["#"] if trial.wildcards else names[:expected]  # by name, as many as one SUBSCRIBE may have
    reader.subscribe(*filters, qos=0)
    reader.ping()
    trial.wait(lambda: len(reader.received) >= expected)
    received_before_pong = reader.pongs[0] if reader.pongs else 0
    late = len(reader.received) - received_before_pong
    return warn(f"{late} of {expected} come later") if late else ok("all of them")


def order(trial: BrokerTrial) -> CheckResult:
    """Check the order in which readers get growing numbers, if they subscribe while these are published."""
    writer, readers, newest = trial.peer(), [trial.peer() for _ in range(8)], 0
    for reader in readers:
        for _ in range(10):
            newest += 1
            writer.publish("state", b"%d" % newest, qos=trial.qos, retain=True)
        reader.subscribe("state", qos=trial.qos)
    writer.ping()
    trial.wait(lambda: all(b"%d" % newest in reader.payloads() for reader in readers))
    trial.wait_quiet(*readers)
    wrong = [reader for reader in readers if reader.payloads()[-1:] != [b"%d" % newest]]
    # Why the last message is wrong: with the retain flag it was sent for the subscription, but after newer live ones. A
    # live one came after the newest, although it is older (`live_last`, which also has the readers that got nothing).
    live_last = [reader for reader in wrong if not reader.received or not reader.received[-1].retain]
    if live_last:
        return failed("the last value that comes to a new subscription is not the newest", OTHER)
    if wrong:
        return warn("a retained value comes after a newer live one")
    if any(map(_has_older_after_newer, readers)):
        return warn("an older value may come between, to who subscribes while others publish; the newest is last")
    return ok("no older value comes after a newer one")


def _has_older_after_newer(reader: Peer) -> bool:
    numbers = [int(payload) if payload.isdigit() else -1 for payload in reader.payloads()]
    return numbers != sorted(numbers)


def restarted(trial: BrokerTrial) -> CheckResult:
    """Check that a retained message is there again after a restart of the broker, for which a person is asked."""
    writer = trial.peer()
    mid = writer.publish("state", b"1", qos=trial.qos, retain=True)
    trial.wait(lambda: mid in writer.acks or not trial.qos)
    if trial.restart is None or not trial.restart():
        return skipped("it was not restarted")
    if writer.ping():
        return skipped("it was not restarted: a connection from before is still open")
    for attempt in range(_TRIES):  # NATS lets clients in some seconds before it has read what it retains
        try:
            late = trial.peer()
        except RefusedError as error:
            return failed(f"it takes no connection since: {error}", "see why in its log")
        late.subscribe("state", qos=trial.qos)
        if trial.wait(lambda: late.received, trial.answer_s / 3):  # noqa: B023
            return ok("it is there again" + (", some seconds later" if attempt else ""))
    trial.late = False  # after a late answer `judge` would try this again, and ask a person for a second restart
    return warn("it is gone", _PERSISTENT)
