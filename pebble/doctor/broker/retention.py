"""Probes of a broker: what it retains, for whom, and in which order that comes."""

from __future__ import annotations

from itertools import count, pairwise

from pebble.check_result import CheckResult
from pebble.doctor.broker import MOSQUITTO, OTHER, fail, ok, skip, warn
from pebble.doctor.broker.peer import Bench, RefusedError, number

_STATES = 200  # retained ones; a robot has some twenty
_TURNS = 6  # in which one asks for it after a restart
_BY_NAME = 8  # filters in one SUBSCRIBE: AWS IoT closes the connection for more
_PERSISTENT = f"{MOSQUITTO}persistence true, persistence_location /var/lib/mosquitto/, autosave_on_changes true"


def by_name(bench: Bench) -> CheckResult:
    fix = f"{MOSQUITTO}retain_available true"
    writer, running = bench.peer(), bench.peer()
    running.subscribe("state", qos=bench.qos)
    for payload in (b"old", b"new"):
        mid = writer.publish("state", payload, qos=bench.qos, retain=True)
        bench.wait(lambda: not bench.qos or mid in writer.acks or writer.closed)  # noqa: B023
    writer.ping()
    bench.retains = False
    if writer.closed:
        bench.retained_nothing()
        return warn(f"it hangs up on them{writer.because}", fix)
    bench.wait(lambda: b"new" in running.payloads())
    if b"new" not in running.payloads():
        return fail("who is subscribed already does not get them", OTHER)
    if any(one.retain for one in running.received):
        return fail("live messages come marked as retained: robots refuse such commands", OTHER)
    writer.leave()
    late = bench.peer()
    late.subscribe("state", qos=bench.qos)
    bench.wait(lambda: late.received)
    bench.wait_quiet(late)
    if not late.received:
        bench.retained_nothing()
        return warn("it retains none", fix)
    if not all(one.retain for one in late.received):
        return fail("they come without the retain flag: a command of yesterday looks new", OTHER)
    if late.payloads()[-1] != b"new":
        return fail("an older value comes instead of the newest", OTHER)
    bench.retains = True
    if len(late.received) > 1:
        return warn(f"one comes {len(late.received)} times to a subscription", "")
    return ok("the newest of each topic, also when its publisher is gone")


def _states(bench: Bench, value: bytes) -> list[str]:
    names = [f"s/{place}" for place in range(_STATES)]
    bench.peer().publish_all(((name, value) for name in names), qos=bench.qos, retain=True)
    return names


def by_wildcard(bench: Bench) -> CheckResult:
    if not bench.retains:
        return skip("it retains nothing")
    names = set(_states(bench, b"1"))
    came = []
    for filter_ in ("s/+", "#"):
        reader = bench.peer()
        reader.subscribe(filter_, qos=0)
        bench.wait(lambda: len(reader.topics()) == len(names) or reader.closed)  # noqa: B023
        came.append(len(reader.topics() & names))
    bench.wildcards = min(came) > 0
    if not min(came):
        return warn("nothing comes: only subscriptions of exact names get retained messages", "")
    if min(came) < len(names):
        return fail(f"{min(came)} of {len(names)} come", f"{MOSQUITTO}max_queued_messages 1000")
    return ok(f"all {len(names)}")


def before_pong(bench: Bench) -> CheckResult:
    if not bench.retains:
        return skip("it retains nothing")
    names, reader = _states(bench, b"1"), bench.peer()
    reader.subscribe(*(["#"] if bench.wildcards else names[:_BY_NAME]), qos=0)
    reader.ping()
    expected = len(names) if bench.wildcards else _BY_NAME
    bench.wait(lambda: len(reader.received) >= expected)
    late = len(reader.received) - (reader.pongs or [0])[0]
    if late:
        return warn(f"{late} of {expected} come later", "")
    return ok("all of them")


def removal(bench: Bench) -> CheckResult:
    if not bench.retains:
        return skip("it retains nothing")
    writer, running = bench.peer(), bench.peer()
    running.subscribe("state", qos=bench.qos)
    for payload in (b"1", b""):
        mid = writer.publish("state", payload, qos=bench.qos, retain=True)
        bench.wait(lambda: not bench.qos or mid in writer.acks or writer.closed)  # noqa: B023
    notified = bench.wait(lambda: b"" in running.payloads())
    late = bench.peer()
    late.subscribe("state", qos=bench.qos)
    bench.wait_quiet(late)
    if late.received:
        return fail("an empty message does not remove what is retained", OTHER)
    if not notified:
        return warn("who is subscribed does not learn of it", OTHER)
    return ok("an empty message removes what is retained")


def order(bench: Bench) -> CheckResult:
    if not bench.retains:
        return skip("it retains nothing")
    writer, readers, numbers = bench.peer(), [bench.peer() for _ in range(8)], count(1)
    for reader in readers:
        for _ in range(10):
            writer.publish("state", b"%d" % next(numbers), qos=bench.qos, retain=True)
        reader.subscribe("state", qos=bench.qos)
    writer.ping()
    bench.wait_quiet(*readers)
    numbers_of = [[number(one) for one in reader.payloads()] for reader in readers]
    newest = next(numbers) - 1
    wrong = [reader for reader, seen in zip(readers, numbers_of, strict=True) if seen[-1:] != [newest]]
    if any(not reader.received or not reader.received[-1].retain for reader in wrong):
        return fail("the last value that comes to a new subscription is not the newest", OTHER)
    if wrong:
        return warn("a retained value comes after a newer live one", "")
    if any(after < before for seen in numbers_of for before, after in pairwise(seen)):
        return warn("an older value may come between, to who subscribes while others publish; the newest is last", "")
    return ok("no older value comes after a newer one")


def restarted(bench: Bench) -> CheckResult:
    if not bench.retains:
        return skip("it retains nothing")
    if bench.restart is None:
        return skip("it was not restarted: doctor --restart and conform --cut ask for that")
    writer = bench.peer()
    mid = writer.publish("state", b"1", qos=bench.qos, retain=True)
    bench.wait(lambda: mid in writer.acks or not bench.qos)
    if not bench.restart():
        return skip("it was not restarted")
    if writer.ping():
        return skip("it was not restarted: a connection from before is still open")
    for turn in range(_TURNS):  # NATS lets clients in some seconds before it has read what it retains
        try:
            late = bench.peer()
        except RefusedError as error:
            return fail(f"it takes no connection since: {error}", "see why in its log")
        late.subscribe("state", qos=bench.qos)
        if bench.wait(lambda: late.received, bench.answer_s / 3):  # noqa: B023
            return ok("it is there again" + (", some seconds later" if turn else ""))
    return warn("it is gone", _PERSISTENT)
