"""What a client that drives owes the robot and its people, as a table: each check, and why it matters.

Pebble plays the robot, a person uses the client as each check asks for, and the check judges what it publishes.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable
from itertools import pairwise

from pebble import contract as c
from pebble.check_result import CheckResult
from pebble.conform.checks import Check, some_of
from pebble.conform.stand_in import Sent, StandIn
from pebble.contract.levels import LEVELS
from pebble.selftest import failed, ok

DRIVE, FULL, LET_GO = "drive ahead, and go on", "push the stick into a corner, as far as it goes", "let go of the stick"
STOP, RESET, END = "press the emergency stop", "reset the emergency stop", "end the client"

_LOOKS_S = 2.0  # at what it sends
_SOON_S = 0.5  # within which a client acts on what it is told, a way to the broker and back included
_SILENT_S = 2.5  # the longest silence of a robot on a wide link after which a client still drives
_GAP_S = 0.75  # wheels stop so long after the last command
_SLOWEST_HZ, _FASTEST_HZ = 8.0, 25.0
_CONFIRMS_S = 1.8  # for so long a stop is not confirmed
_SLOWER = 1.5  # times the rate of a link, for what was on its way
_HARMLESS = (c.CONTROL,)
_NAME = re.compile("[0-9a-f]{16}")
_OTHER = "other"
_DRIVE_FIX = "publish incoming/drive-values while it is pushed"


# -- what the person does


def _asks(robot: StandIn, text: str, done: Callable[[], object]) -> str:
    """Ask for it, unless it is so; empty, or what did not happen."""
    robot.ask(text)
    return "" if robot.wait(done, robot.person_s) else f"asked to {text}: nothing came within {robot.person_s:g} s"


def _moves_now(robot: StandIn) -> bool:
    return bool(robot.inbox.moving(time.monotonic() - _SOON_S))


def _rests(robot: StandIn, text: str = LET_GO) -> str:
    """The stick is at rest; a client that has been kept from driving may not have to tell so."""
    if not _moves_now(robot):
        robot.ask(text)
        robot.look(_SOON_S)
        return ""
    began = time.monotonic()
    return _asks(robot, text, lambda: [one for one in robot.inbox.of(c.DRIVE, began) if one.value and not one.moves])


def _drives(robot: StandIn, text: str = DRIVE) -> str:
    if text == DRIVE and _moves_now(robot):
        return ""
    began = robot.look(0.0)
    return _asks(robot, text, lambda: robot.inbox.moving(began))


def _while_driving(test: Callable[[StandIn], CheckResult]) -> Callable[[StandIn], CheckResult]:
    def run(robot: StandIn) -> CheckResult:
        why = _drives(robot)
        return failed(why, _DRIVE_FIX) if why else test(robot)

    return run


def _at_rest_again(robot: StandIn) -> None:
    """A fresh start: free, alive, and the person has let go."""
    robot.alive = True
    robot.give_to("")
    robot.link("wide")
    if robot.stop.latched:
        robot.free()
    _rests(robot)


# -- at rest


def idle(robot: StandIn) -> CheckResult:
    began = robot.look(_LOOKS_S)
    found = sorted({one.metric for one in robot.inbox.sent if one.at >= began and one.channel not in _HARMLESS})
    if found:
        return failed(f"it publishes {some_of(found)}", "publish commands only while a person gives some")
    return ok("it waits for its person")


# -- while it drives


def control(robot: StandIn) -> CheckResult:
    since = robot.look(_LOOKS_S)
    wrong = [one for one in robot.inbox.moving() if one.raw.get("key") in (None, "")]
    if wrong:
        return failed(
            f"{len(wrong)} commands without a key", "move nothing before outgoing/control has your id and a key"
        )
    foreign = [one for one in robot.inbox.moving(since) if robot.control.key not in one.value.key.split()]
    if foreign:
        return failed(f"{len(foreign)} commands with another key", "take the newest key of outgoing/control/{owner}")
    return ok("it asks first, and drives with its key")


def requests(robot: StandIn) -> CheckResult:
    """One that asks by many ids gets no key that it could drive with."""
    why = _drives(robot)
    began = robot.look(0.0 if why else 2 * _LOOKS_S)
    found = [one.value for one in robot.inbox.of(c.CONTROL) if one.value]
    ids = {one.id for one in found}
    if len(ids) > 1:
        return failed(f"its ids: {some_of(sorted(ids))}", "make 8 hex digits when it starts, and keep them")
    if why:
        return failed(why, _DRIVE_FIX)
    if not robot.inbox.of(c.CONTROL, began):
        return failed(f"none in {2 * _LOOKS_S:g} s of driving", 'repeat {"want": "hold"} every second')
    takes = robot.inbox.of(c.CONTROL_TAKE)
    if takes:
        return failed("it takes control where it is free", "take only when a person wants it taken from another")
    return ok("one id, repeated")


def payloads(robot: StandIn) -> CheckResult:
    wrong = [one.wrong for one in robot.inbox.sent if one.wrong]
    unknown = sorted({one.metric for one in robot.inbox.sent if one.channel is None})
    if wrong or unknown:
        return failed(some_of(wrong or unknown), "docs/topics.md has each topic and payload")
    return ok(f"{len({one.metric for one in robot.inbox.sent})} kinds of messages")


def numbers(robot: StandIn) -> CheckResult:
    for one in robot.inbox.sent:
        if (one.channel is c.DRIVE or b"NaN" in one.payload) and not _numbers(one):
            return failed(f"{one.payload[:60]!r}", "x and z are finite numbers, as JSON has them")
    return ok("all are numbers")


def _numbers(one: Sent) -> bool:
    def refuse(text: str) -> None:
        raise ValueError(text)

    try:
        value = json.loads(one.payload, parse_constant=refuse)
    except (ValueError, RecursionError):
        return False
    axes = [value.get(axis, 0) for axis in ("x", "y", "z")] if isinstance(value, dict) else [None]
    return all(isinstance(axis, int | float) and abs(axis) < float("inf") for axis in axes)


def clamps(robot: StandIn) -> CheckResult:
    began = time.monotonic()
    if why := _drives(robot, FULL):
        return failed(why, _DRIVE_FIX)
    robot.look(_SOON_S)
    axes: list[float] = [one.raw.get(axis, 0) for one in robot.inbox.moving(began) for axis in ("x", "z")]
    largest = max(map(abs, axes))
    if largest > 1:
        return failed(f"it sends {largest:g}", "clamp both axes to -1..1: some robots do not")
    return ok(f"{largest:g} at most")


def rate(robot: StandIn) -> CheckResult:
    began = robot.look(_LOOKS_S)
    times = [began, *(one.at for one in robot.inbox.moving(began)), time.monotonic()]
    hz, gap = (len(times) - 2) / _LOOKS_S, max(after - before for before, after in pairwise(times))
    if gap > _GAP_S:
        return failed(f"a gap of {gap:.2f} s", f"repeat it at 20 Hz: wheels stop {_GAP_S:g} s after the last command")
    if hz > _FASTEST_HZ or hz < _SLOWEST_HZ:
        return failed(f"{hz:.0f} commands a second", "send 20 a second")
    return ok(f"{hz:.0f} a second")


def stamps(robot: StandIn) -> CheckResult:
    drives = robot.inbox.moving()
    times = [one.value.t for one in drives if isinstance(one.value.t, int)]
    if not times:
        return ok("it sends none")
    if any(after < before for before, after in pairwise(times)):
        return failed("t goes back", "take a clock that is never set, in milliseconds")
    if any(isinstance(one.value.t, int) and not one.value.key for one in drives):
        return failed("t without a key", "a stamp counts only with the key of control")
    passed = 1000 * (drives[-1].at - drives[0].at)
    if abs(times[-1] - times[0] - passed) > 0.25 * passed + 500:
        return failed(f"t grew by {times[-1] - times[0]} in {passed:.0f} ms", "t is in milliseconds")
    return ok("it tells its clock")


def thin(robot: StandIn) -> CheckResult:
    robot.link("thin")
    level = LEVELS["thin"]
    robot.look(1.0)
    began = robot.look(2 * _LOOKS_S)
    found = robot.inbox.moving(began)
    robot.link("wide")
    hz = len(found) / (2 * _LOOKS_S)
    if hz > level.drive_hz * _SLOWER:
        return failed(
            f"{hz:.0f} commands a second", "follow drive_hz of outgoing/link: else they queue, and a stop waits"
        )
    if hz < 1 / level.valid_ms * 1000:
        return failed(f"{hz:.1f} commands a second", f"send {level.drive_hz:g} a second at this level")
    if any(not isinstance(one.value.t, int) for one in found):
        return failed(
            "commands without t", 'send "t" and "key" at levels narrow and thin: late ones are dropped by them'
        )
    return ok(f"{hz:.0f} a second, stamped")


# -- the end of a drive


def zero(robot: StandIn) -> CheckResult:
    if why := _rests(robot):
        return failed(why, "publish a zero at once when the stick is let go")
    began = robot.look(_SOON_S)
    last = [one for one in robot.inbox.of(c.DRIVE) if one.value][-1]
    if robot.inbox.moving(began) or last.moves:
        return failed("it moves after its zero", "nothing follows a zero until the stick is pushed again")
    if last.qos < 1:
        return failed("its zero has QoS 0", "publish a zero with QoS 1: it must not be lost")
    before = robot.inbox.moving()[-1].at
    first = next(one for one in robot.inbox.of(c.DRIVE, before) if not one.moves)
    if first.at > before + _SOON_S:
        return failed(f"its zero came {first.at - before:.1f} s after the last command", "publish it at once")
    return ok("a zero at once")


def _gives_up(robot: StandIn, after_s: float, state: str, fix: str) -> CheckResult:
    """Whether it moves nothing any more, once the robot has been in this state for so long."""
    robot.look(after_s)
    moved = robot.inbox.moving(robot.look(1.0))
    _at_rest_again(robot)
    return failed(f"it drives a robot that is {state}", fix) if moved else ok(f"it ends when the robot is {state}")


def silence(robot: StandIn) -> CheckResult:
    robot.alive = False
    return _gives_up(robot, _SILENT_S, "silent", "end when no heartbeat came for 1.5 s")


def offline(robot: StandIn) -> CheckResult:
    robot.gone()
    return _gives_up(robot, _SOON_S, "offline", 'end at outgoing/online {"online": false}')


def taken(robot: StandIn) -> CheckResult:
    robot.give_to(_OTHER)
    robot.look(_SOON_S)
    began = robot.look(_LOOKS_S)
    moved, took = robot.inbox.moving(began), robot.inbox.of(c.CONTROL_TAKE, began)
    _at_rest_again(robot)
    if moved or took:
        return failed(
            "it takes control back" if took else "it drives on", "end when outgoing/control/{owner} has another id"
        )
    return ok("it ends when another takes control")


def refused(robot: StandIn) -> CheckResult:
    robot.look(_SOON_S)
    robot.give_to(_OTHER)
    began = time.monotonic()
    why = _asks(robot, DRIVE, lambda: robot.inbox.of(c.CONTROL, began) or robot.inbox.of(c.CONTROL_TAKE, began))
    robot.look(_LOOKS_S)
    moved, took = robot.inbox.moving(began), robot.inbox.of(c.CONTROL_TAKE, began)
    _at_rest_again(robot)
    if moved or took:
        return failed(
            "it takes control" if took else "it moves it", "wait while another has control, and tell the person so"
        )
    if why:
        return failed(
            "it does not ask for control", 'publish incoming/control {"want": "hold"}: its driver is shown it'
        )
    return ok("it asks, and waits")


# -- the emergency stop


def stop(robot: StandIn) -> CheckResult:
    robot.confirms, began = False, time.monotonic()
    why = _asks(robot, STOP, lambda: robot.inbox.of(c.ESTOP, began))
    robot.look(_CONFIRMS_S)
    robot.confirms = True
    if why:
        return failed(why, "publish incoming/estop")
    names = [str(one.raw.get("stop")) if isinstance(one.raw, dict) else "" for one in robot.inbox.of(c.ESTOP, began)]
    if not all(_NAME.fullmatch(one) for one in names):
        return failed("it has no name", 'give it {"stop": <16 hex digits>}')
    if len(set(names)) > 1:
        return failed("its repetitions have other names", "a new name for each press, and the same in its repetitions")
    if len(names) < 2 + robot.named:
        return failed("it is not repeated", "repeat it every 0.5 s until each owner has its name in recent")
    confirmed = robot.wait(lambda: robot.stop.latched, _CONFIRMS_S)
    robot.look(_SOON_S)
    more = robot.inbox.of(c.ESTOP, robot.look(_LOOKS_S))
    if more or not confirmed:
        return failed("it is repeated after it was confirmed", "end when each owner has its name in recent")
    return ok("repeated until it is confirmed")


def stopped(robot: StandIn) -> CheckResult:
    """The stick is pushed while the robot is stopped."""
    _latched(robot)
    began = robot.look(0.0)
    robot.ask(DRIVE)
    robot.look(2 * _LOOKS_S)
    moved, resets = robot.inbox.moving(began), robot.inbox.of(c.ESTOP_RESET)
    still = robot.stop.latched
    robot.ask(LET_GO)
    robot.look(_SOON_S)
    if resets or not still:
        return failed("it resets the stop by itself", "publish a reset only when a person wants it")
    return (
        failed("it drives a stopped robot", "end while any owner is latched") if moved else ok("it waits for a reset")
    )


def _latched(robot: StandIn) -> None:
    if not robot.stop.latched:
        robot.latch("f" * 16)
        robot.look(_SOON_S)


def reset(robot: StandIn) -> CheckResult:
    _latched(robot)
    began, count = time.monotonic(), robot.stop.count
    why = _asks(robot, RESET, lambda: robot.inbox.of(c.ESTOP_RESET, began))
    robot.wait(lambda: not robot.stop.latched, _SOON_S)
    is_free = not robot.stop.latched
    _at_rest_again(robot)
    if why or not is_free:
        return failed(
            why or "it is not that of the state", f'publish the boot and count of the state, now {{"count": {count}}}'
        )
    return ok("it ends the stop that is shown")


# -- all of it


def names(robot: StandIn) -> CheckResult:
    plain = sorted(
        {one.metric for one in robot.inbox.sent if not one.account and one.channel is not c.ESTOP and _acts(one)}
    )
    if plain:
        return failed(f"without a name: {some_of(plain)}", "publish on incoming/by/{account}/…")
    bare = [one for one in robot.inbox.of(c.ESTOP) if not one.account]
    if not bare:
        return failed("its stop needs a name", "publish a stop on incoming/estop, too: it counts from everyone")
    return ok("its commands have its name")


def _acts(one: Sent) -> bool:
    return one.channel is not c.DRIVE or one.moves


def _named(robot: StandIn) -> str:
    return "" if robot.named else "names are not checked here: use an account, as in --url mqtts://ROBOT@BROKER"


def retained(robot: StandIn) -> CheckResult:
    found = robot.retained()
    if found:
        return failed(some_of(found), "publish commands without the retain flag: they are carried out at every start")
    return ok("none is retained")


def release(robot: StandIn) -> CheckResult:
    if why := _drives(robot):
        return failed(why, _DRIVE_FIX)
    began = time.monotonic()
    robot.ask(END)
    released = robot.wait(lambda: not robot.control.key and _released(robot, began), _LOOKS_S)
    drives = [one for one in robot.inbox.of(c.DRIVE) if one.value]
    if not released:
        return failed("control is kept until it ends by itself", 'publish {"want": "release"} when it ends')
    return (
        failed("its last command moves the robot", "publish a zero first") if drives[-1].moves else ok("it is released")
    )


def _released(robot: StandIn, since: float) -> bool:
    return any(one.value and one.value.want == "release" for one in robot.inbox.of(c.CONTROL, since))


OPERATOR: tuple[Check[StandIn], ...] = (
    Check("idle", "a client that opens must change nothing", idle),
    Check("control", "a robot that gives control refuses commands without its key", _while_driving(control)),
    Check("requests", "control ends when it is not renewed, and others must get it", requests),
    Check("rate", "wheels stop without commands, and a flood holds up stops", _while_driving(rate)),
    Check("stamps", "a robot drops late commands by the clock of their sender", _while_driving(stamps)),
    Check("thin link", "on a thin link commands queue, and a stop waits behind them", _while_driving(thin)),
    Check("clamps", "motors get no more than everything", clamps),
    Check("zero", "who lets go expects it to stop at once", _while_driving(zero)),
    Check("silence", "nobody sees what a silent robot does", _while_driving(silence)),
    Check("offline", "a robot that comes back must not start by itself", _while_driving(offline)),
    Check("taken", "who took control must drive alone", _while_driving(taken)),
    Check("refused", "one person drives at a time", refused),
    Check("stop", "a stop must arrive, and people must see that it has", stop),
    Check("stopped", "only a person ends a stop", stopped),
    Check("reset", "a reset must end only the stop that its sender saw", reset),
    Check("names", "where names are checked, commands without one move nothing", names, (_named,)),
    Check("payloads", "what does not fit the contract is not read", payloads),
    Check("numbers", "NaN is no JSON, and no speed", numbers),
    Check("release", "the next one must not wait", release),
    Check("retained", "a command that a broker keeps is carried out at every start", retained),
)
