"""The table of a robot's duties towards those who watch or stop it. No check here turns a wheel."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Collection, Iterator
from itertools import pairwise

import msgspec

from pebble import contract as c
from pebble.check_result import CheckResult, State, failed, ok, skipped
from pebble.contract.capabilities import CapabilitiesValue
from pebble.contract.identity import parse_topic
from pebble.contract.levels import silent_after
from pebble.contract.payloads import ControlRequest, EstopCommand, EstopReset
from pebble.extensions.checks.check import Check, some_of
from pebble.extensions.checks.observer import ANSWER_S, Observer, available, why_not_free
from pebble.extensions.operator.client.robot_topics import section_of
from pebble.extensions.operator.client.robot_view import RobotView

_CLOCK_S = 60.0  # that its clock may differ
_LARGEST = 64 * 1024  # bytes of JSON
_LARGEST_STATE = 400  # bytes of a state of the emergency stop
_REPEATED = (c.CHARGING_STATUS, c.CHARGING_LEVEL)  # boards of the original repeat them every 5 s instead
_SLOWEST_S = 1.25  # between heartbeats, by their mean; they are to come each second
BY, _WHY = "conform", "conformance test"
END_IT = "end it on incoming/estop-reset"

_LONG = b"[" * 2000
_LONGS, _BURSTS = 25, 2  # mosquitto sends nothing more while 20 are unacknowledged, but one for each that is so late
#: Of what a program with an error sends. A robot reads none of it, and goes on.
JUNK = (b"", b"{", b"[]", b"null", b'"x"', b"\xff\xfe\x00", _LONG, b'{"x": ' + b"9" * 400 + b"}")
_LARGE = b"x" * 70_000  # once: small boards take a while to read it


# -- what a check needs: empty, or why it is lacking


def _offered(what: str, offers: Callable[[RobotView], bool]) -> Callable[[Observer], str]:
    return lambda robot: "" if offers(robot.view) else f"its capabilities offer no {what}"


drives = _offered("driving", lambda view: view.drives)
stops = _offered("emergency stop", lambda view: view.estop.available)
controls = _offered("control", lambda view: view.controlled)


def free(robot: Observer) -> str:
    """Return who still drives the robot or has stopped it; empty if it is free.

    First it waits for the end of the previous check's effects.
    """
    robot.wait(lambda: not why_not_free(robot.view), ANSWER_S)
    return why_not_free(robot.view)


def commanded(robot: Observer) -> str:
    """Return why the robot takes no commands from this account; empty if it takes them."""
    if robot.view.named and not robot.account:
        return "it takes commands only with a name: use an account, as in --url mqtts://ANN@BROKER"
    return ""


def readable(robot: Observer) -> str:
    """Return why this account cannot read requests to the robot; empty if it gets back the harmless one it sends."""
    account = (robot.account or "") if robot.view.named else ""
    is_read = robot.send_as(account, c.CONTROL, ControlRequest(id=secrets.token_hex(4), want="release"))
    return "" if is_read else "its broker does not let this account read incoming/: use an admin's"


# -- signs of life


def heartbeat(robot: Observer) -> CheckResult:
    beats = robot.of(c.ONLINE)
    if not beats:
        return failed("none arrived", 'publish {"t": <epoch ms>} on outgoing/online every 0.25 s to 1 s')
    wrong = [beat.wrong for beat in beats if beat.wrong]
    if wrong:
        return failed(wrong[0], 'its payload is {"t": <epoch milliseconds, an integer>}')
    gaps = [after.at - before.at for before, after in pairwise(beats)]
    interval = robot.view.liveness.interval_s
    if len(gaps) < 2 or interval is None:
        return failed(f"{len(beats)} in the time of observation", "publish one at least every second")
    longest = silent_after(interval, robot.view.liveness.link, 0.0)  # 0.0: nothing for delays on the way
    if max(gaps) > longest:
        return failed(f"a gap of {max(gaps):.1f} s, where {longest:.1f} s counts as silence", "publish them evenly")
    if interval > _SLOWEST_S and robot.view.liveness.link == "wide":
        return failed(f"one every {interval:.2f} s", "publish one at least every second: its silence is seen late")
    return ok(f"every {interval:.2f} s")


def clock(robot: Observer) -> CheckResult:
    heartbeats = robot.of(c.ONLINE)
    if not heartbeats or heartbeats[-1].wrong:
        return skipped("there is no heartbeat")
    newest = heartbeats[-1]
    received_s = time.time() - (time.monotonic() - newest.at)
    ahead_s = newest.value.t / 1000 - received_s
    if abs(ahead_s) > _CLOCK_S:
        text = f"its clock is {abs(ahead_s):.0f} s {'ahead' if ahead_s > 0 else 'behind'}"
        return failed(text, "set it, by SNTP for example")
    return ok(f"{1000 * ahead_s:+.0f} ms")


# -- what it publishes


def _none_of(wrong: Collection[str], fix: str, fine: str, what: str = "") -> CheckResult:
    """Return a failure that names the first ``wrong`` items after the words ``what``; a pass if there are none."""
    return failed(f"{what}{some_of(sorted(wrong))}", fix) if wrong else ok(fine)


def payloads(robot: Observer) -> CheckResult:
    wrong = {record.metric: record.wrong for record in robot.records if record.wrong}
    kinds = {record.metric for record in robot.records if record.channel}
    return _none_of(wrong.values(), "see `pebble topic contract --json-schema`", f"{len(kinds)} kinds of messages")


def numbers(robot: Observer) -> CheckResult:
    """Check that every payload that should be JSON is JSON, which has no NaN and no Infinity."""
    strange = set()
    for record in robot.records:
        if record.channel and record.channel.payload is not bytes and record.payload:
            try:
                msgspec.json.decode(record.payload)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
                strange.add(record.metric)
    fix = "NaN, Infinity and comments are no JSON: leave the field out"
    return _none_of(strange, fix, "all JSON is JSON", "not JSON: ")


def sizes(robot: Observer) -> CheckResult:
    large = set()
    for record in robot.records:
        most = _LARGEST_STATE if record.channel is c.ESTOP_STATE else _LARGEST
        if len(record.payload) > most and (record.channel is None or record.channel.payload is not bytes):
            large.add(f"{record.metric} has {len(record.payload)} bytes, more than {most}")
    return _none_of(large, "send less: readers drop it", "no message is too large")


def retained(robot: Observer) -> CheckResult:
    """Check that the channels of states are published with the retain flag, and no others."""
    retained_metrics = {record.metric for record in robot.retained()}
    lacking, surplus = set(), set()
    for record in robot.records:
        channel, is_retained = record.channel, record.metric in retained_metrics
        if channel is None or not record.payload:
            continue
        if channel.default_retain and channel not in _REPEATED and not is_retained:
            lacking.add(record.metric)
        if is_retained and not channel.default_retain and channel is not c.MCU_VALUE:  # its manifest decides
            surplus.add(record.metric)
    if lacking:
        fix = "publish it with the retain flag: who connects later lacks it"
        return failed(f"not retained: {some_of(sorted(lacking))}", fix)
    fix = "publish it without the retain flag: it is news only once"
    return _none_of(surplus, fix, f"{len(retained_metrics)} states", "retained: ")


def stale_commands(robot: Observer) -> CheckResult:
    parked = sorted(record.metric for record in robot.retained() if record.channel and record.channel.one_shot)
    topic = f"{robot.base}/{next(iter(parked), '')}"
    return _none_of(parked, f"remove it: mosquitto_pub -r -n -t '{topic}'; and find who publishes it so", "none")


# -- what it offers


def capabilities(robot: Observer) -> CheckResult:
    published = robot.of(c.CAPABILITIES, retained=True)
    if not published:
        return failed("it publishes none: pages offer nothing of it", "publish outgoing/capabilities, retained")
    try:
        msgspec.convert(published[-1].value.value, CapabilitiesValue)
    except (msgspec.ValidationError, ValueError, AttributeError) as error:  # AttributeError: it could not be decoded
        return failed(str(published[-1].wrong or error), "CapabilitiesValue in `pebble topic contract --json-schema`")
    return ok(some_of(sorted(available(robot.view.capabilities)), 20) or "nothing is offered")


def own_topics(robot: Observer) -> CheckResult:
    """Check that all topics in the capabilities are the robot's own, and valid."""
    foreign = {
        f"{path} is {topic}"
        for path, topic in _topics(robot.view.capabilities, "")
        if not topic.startswith(f"{robot.base}/") or parse_topic(topic) is None
    }
    fix = f"topics in capabilities begin with {robot.base}/: others are not used"
    return _none_of(foreign, fix, "all are its own")


def _topics(value: object, path: str) -> Iterator[tuple[str, str]]:
    """Yield each value whose key says that it is a topic, at any depth."""
    fields = value if isinstance(value, dict) else {}
    for key, inner in fields.items():
        where = f"{path}.{key}".lstrip(".")
        parts = inner if isinstance(inner, list) else [inner]
        if isinstance(inner, str) and key.endswith("topic"):
            yield where, inner
        if isinstance(inner, list) and key.endswith("topics"):
            yield from ((where, str(topic)) for topic in inner)
        for part in parts:
            yield from _topics(part, where)


def identity(robot: Observer) -> CheckResult:
    section = section_of(robot.view.capabilities, "identity")
    if not section:
        return skipped("it lists no identity")
    listed = "/".join(str(section.get(level)) for level in ("system", "type", "id"))
    if listed != robot.base:
        return failed(f"it calls itself {listed}", "identity is that of its topics")
    return ok(listed)


# -- what it does with what it cannot read


def junk(robot: Observer) -> CheckResult:
    """Check that the robot goes on with its heartbeats after messages that no program should send."""
    began = time.monotonic()
    for channel in (c.DRIVE, c.LIGHTS_SOLID, c.CONTROL, c.ESTOP_RESET, c.AUTONOMY_COMMAND):
        for payload in JUNK:
            robot.send(channel, payload)
    robot.send(c.DRIVE, _LARGE)
    sent_at = robot.sent(ANSWER_S)
    interval_s = robot.view.liveness.interval_s or ANSWER_S
    # Heartbeats of the first two intervals may have been sent before the robot had read all of it.
    if not robot.wait(lambda: len(robot.of(c.ONLINE, sent_at + 2 * interval_s)) >= 2, 6 * interval_s + ANSWER_S):
        return failed("its heartbeats ended", "drop what is no JSON of the contract, and go on")
    if any(beat.value and beat.value.online is False for beat in robot.of(c.ONLINE, began)):
        return failed("it went offline meanwhile", "drop what cannot be read")
    return ok("it goes on")


# -- the emergency stop


def owners(robot: Observer) -> CheckResult:
    lacks = [topic.removeprefix(f"{robot.base}/") for topic in robot.view.estop.missing]
    fix = "publish it, retained, for each owner that capabilities list"
    return _none_of(lacks, fix, ", ".join(sorted(robot.view.estop.states)), "no state of ")


def stop(robot: Observer, name: str) -> bool:
    """Send a stop; True if each motor owner confirms it in time."""
    robot.send(c.ESTOP, EstopCommand(stop=name, by=BY, why=_WHY))

    def latches() -> bool:
        owners = robot.view.estop.states.values()
        return bool(owners) and all(state.latched and name in state.recent for state in owners)

    return robot.answers(latches)


def _counts(robot: Observer) -> dict[str, int]:
    return {owner: state.count for owner, state in robot.view.estop.states.items()}


def reset(robot: Observer, *, boot: str = "", more: int = 0) -> None:
    """Send each motor owner a reset of its present stop.

    An owner must refuse one with another ``boot`` than its own, or with a count that is ``more`` stops ahead.
    """
    for state in robot.view.estop.states.values():
        robot.send(c.ESTOP_RESET, EstopReset(boot=boot or state.boot, count=state.count + more, by=BY))


def freed(robot: Observer) -> bool:
    reset(robot)
    return robot.answers(lambda: not robot.view.latched)


def while_stopped(test: Callable[[Observer, str], CheckResult]) -> Callable[[Observer], CheckResult]:
    """Return a check that runs ``test`` while a new stop holds the robot, and then resets the stop."""

    def run(robot: Observer) -> CheckResult:
        name = secrets.token_hex(8)
        try:
            if not stop(robot, name):
                text = f"no state has its name within {ANSWER_S:g} s"
                return failed(text, 'latch on incoming/estop, and publish outgoing/estop/{owner} with "recent"')
            outcome = test(robot, name)
        finally:
            is_free = freed(robot)
        if not is_free and outcome.state is not State.FAILED:
            return failed("a reset with its boot and count does not end it", END_IT)
        return outcome

    return run


def _confirmed(_robot: Observer, _name: str) -> CheckResult:
    return ok("each owner latches, confirms it by name, and is free after a reset")


def _after_long_ones(robot: Observer) -> CheckResult:
    """Check that a stop still reaches the robot after messages that are too long for small boards."""
    try_stop = while_stopped(_confirmed)  # a check: a stop is confirmed, and ends by its reset
    if try_stop(robot).state is not State.OK:  # OK: it has read all that was sent before
        return skipped("no stop reaches it without them, either")
    for _ in range(_BURSTS):
        for _ in range(_LONGS):
            robot.send(c.CONTROL, _LONG)
        robot.sent(ANSWER_S)
        robot.look(ANSWER_S)
    if try_stop(robot).state is State.OK:
        return ok("a stop reaches it after them")
    return failed(
        f"after {_BURSTS * _LONGS} messages of {len(_LONG)} bytes no stop reaches it, until it connects again",
        "acknowledge what is too long to be read, too, or subscribe with QoS 0; and start it anew now",
    )


def _repeated(robot: Observer) -> CheckResult:
    """Check that sending the same stop again changes nothing, before the reset and after it."""
    stop_names: list[str] = []  # the name that while_stopped chose

    def send_same_stop(robot: Observer, name: str) -> CheckResult:
        """Check that the stop called ``name``, which the robot knows already, is not counted again."""
        stop_names.append(name)
        before = _counts(robot)
        robot.send(c.ESTOP, EstopCommand(stop=name, by=BY, why=_WHY))
        robot.look(robot.patience_s)
        counted = [owner for owner, count in _counts(robot).items() if count != before.get(owner)]
        if counted:
            return failed(f"its repetition counts again ({some_of(counted)})", "a name in recent is the same stop")
        return ok("the same stop counts once")

    outcome = while_stopped(send_same_stop)(robot)
    if outcome.state is State.OK:
        outcome = send_same_stop(robot, stop_names[0])
        if robot.view.latched:
            outcome = failed("its repetition after a reset stops it again", "keep recent when the stop ends")
            freed(robot)
    return outcome


def _unreadable(robot: Observer, _name: str) -> CheckResult:
    before = _counts(robot)
    robot.send(c.ESTOP, b"stop!")
    if not robot.answers(lambda: all(count > before.get(owner, 0) for owner, count in _counts(robot).items())):
        fix = "whatever arrives on incoming/estop is a stop, if not empty"
        return failed("a stop that is no JSON does nothing", fix)
    robot.look(robot.patience_s)  # at level named it was sent with a name and without: wait for both
    return ok("what cannot be read stops, too")


def _wrong_reset(robot: Observer, _name: str) -> CheckResult:
    for more, boot, what in ((-1, "", "an older count"), (0, "ffffffff", "another boot")):
        reset(robot, boot=boot, more=more)
        if robot.happens(lambda: not robot.view.latched):
            return failed(f"a reset with {what} ends it", "reset only with the boot and count of the state now")
    return ok("it is refused")


def _holds(robot: Observer, _name: str) -> CheckResult:
    robot.send(c.DRIVE, b'{"x": 0, "z": 0}')
    if robot.happens(lambda: not robot.view.latched):
        return failed("a drive command ends the stop", "only a reset ends it")
    return ok("a drive command does not end it")


_STOP, _READ = (stops, free, commanded), (commanded, readable)

CHECKS: tuple[Check[Observer], ...] = (
    Check("heartbeat", heartbeat, why="without it the robot is shown as offline, and not driven"),
    Check("clock", clock, why="people are shown how old messages are"),
    Check("payloads", payloads, why="what does not fit the contract is not read"),
    Check("numbers", numbers, why="NaN is no JSON, and no speed"),
    Check("sizes", sizes, why="boards and pages have little room"),
    Check("retained", retained, why="who connects later must know its state, and must not take old news for new"),
    Check("parked commands", stale_commands, _READ, "a command that a broker keeps is obeyed at every start"),
    Check("capabilities", capabilities, why="pages offer what they list, and no more"),
    Check("own topics", own_topics, why="topics of others are not used"),
    Check("identity", identity, why="it is known by its topics"),
    Check("junk", junk, (commanded,), "one program with an error must not end it"),
    Check("stop states", owners, (stops,), "a stop is confirmed only when each owner tells it"),
    Check("stop", while_stopped(_confirmed), _STOP, "people must see that it has stopped"),
    Check("stop once", _repeated, _STOP, "stops are repeated until they are confirmed"),
    Check("stop unread", while_stopped(_unreadable), _STOP, "a stop must not fail for a comma"),
    Check("stop holds", while_stopped(_holds), _STOP, "only a person ends it"),
    Check("reset refused", while_stopped(_wrong_reset), _STOP, "a reset must end only the stop that its sender saw"),
)

#: It comes after all that is sent to a robot, because one that fails is deaf.
LAST: tuple[Check[Observer], ...] = (
    Check("long messages", _after_long_ones, _STOP, "what a broker holds back for them may be a stop"),
)
