"""Checks of the emergency stop and of retained commands. No wheel turns, and the robot is free afterwards."""

import time

from pebble.checks.check import CheckResult, failed, ok, skipped
from pebble.checks.running.robot import RobotUnderTest
from pebble.client.estop import StopSender, new_name
from pebble.client.estop_states import Reset
from pebble.contract import ESTOP_RESET, ESTOP_STATE, codec
from pebble.contract.payloads import EstopReset
from pebble.transports import QoS

_CONFIRMED_S = 5.0  # it is repeated every half second
_WHY = "selftest"
_NO_BOOT, _NO_COUNT = "selftest", 1_000_000  # of no start of a motor owner, and of no stop


def stop(robot: RobotUnderTest) -> CheckResult:
    """Stop it as operators do, and end exactly this stop on its own side."""
    before = {owner: state.recent for owner, state in robot.view.estop.states.items()}
    side, name = robot.way, new_name()
    sender = StopSender(name, by=robot.by, why=_WHY, now=time.monotonic(), robots=[robot.config.base])
    stopped = sender.robots[robot.config.base]
    stopped.estop = side.view.estop  # as it is known already, with its topics
    side.listeners.append(sender.receive)

    def confirmed() -> bool:
        side.publish(sender.tick(time.monotonic()))
        return sender.confirmed

    try:
        robot.wait(confirmed, _CONFIRMED_S)
        took_s, why = stopped.confirmed_s, stopped.why
    finally:  # also when this is interrupted: what it has stopped, it ends
        left = _ended(robot, name, before)
    if left:
        return failed(left, "pebble estop reset CONFIG")
    if took_s is None:
        text = f"NOT CONFIRMED after {_CONFIRMED_S:g} s: {why}"
        return failed(text, "pebble doctor CONFIG; pebble estop CONFIG")
    from_ = "its own side" if side.own else "operators"
    return ok(f"confirmed {took_s:.2f} s after {from_} sent it, and ended by name")


def _ended(robot: RobotUnderTest, name: str, before: dict[str, list[str]]) -> str:
    """End this stop; return why the robot stays stopped, or nothing."""
    view = robot.inside.view
    robot.wait(lambda: all(name in state.recent for state in view.estop.states.values()), 1.0)
    if not view.latched:
        return ""
    for owner, state in view.estop.latched.items():
        if state.recent[:1] != [name] or not set(state.recent[1:]) <= set(before.get(owner, [])):
            return f"it was stopped by another one meanwhile, and stays so ({state.by or 'unknown'}: {state.why})"
    reset = Reset(view.estop, robot.by)
    if not robot.inside.publish(reset.messages()):
        return "the end of the stop was not sent: it stays stopped"
    robot.wait(lambda: not reset.waiting, robot.patience_s)
    refused = [f"{owner}: {why}" for owner, why in reset.refusals().items()]
    return f"it stays stopped: {', '.join(refused)}" if refused else ""


def retained_commands(robot: RobotUnderTest) -> CheckResult:
    """Leave a command retained at the broker, one that could do no harm, and see that the robot ignores it.

    It is a reset that no motor owner could take: who reads it, publishes why it refuses it. A live one of another kind
    follows, so that the silence before it means something.
    """
    operators = robot.operators
    assert operators is not None  # noqa: S101 - the table says so
    if robot.inside.heartbeats:
        return skipped("one broker serves both sides: there, what is published to be retained is live at first")
    owner, state = next(iter(robot.view.estop.states.items()), (None, None))
    if owner is None or state is None:
        return skipped("it publishes no emergency stop")
    if state.reset_refused is not None:
        return skipped("it refused a reset before, which looks the same", "run it again")
    topic, metric = ESTOP_RESET.topic(robot.config.base), ESTOP_STATE.suffix.format(owner=owner)
    began = time.monotonic()

    def refused() -> set[str | None]:
        states = [record for record in operators.of(ESTOP_STATE, began) if record.metric == metric]
        return {record.value.reset_refused for record in states if record.value is not None}

    def leave(payload: bytes) -> None:
        beside.publish(topic, payload, qos=QoS.DELIVERED, retain=True, remember=False)
        robot.wait(lambda: beside.outgoing.waiting == 0, robot.patience_s)

    with operators.beside("selftest") as (beside, _):  # it puts no name into the topic: nothing with one is retained
        try:
            leave(codec.encode(ESTOP_RESET, EstopReset(boot=_NO_BOOT, count=0, by=_WHY)))
            operators.send(ESTOP_RESET, EstopReset(boot=state.boot, count=state.count + _NO_COUNT, by=_WHY))
            robot.wait(lambda: "count" in refused(), robot.patience_s)
        finally:
            leave(b"")
    if "boot" in refused():
        return failed("it read a retained command as if it were sent now", "pebble doctor CONFIG")
    if "count" not in refused():
        return skipped("a live one of this account is not answered either")
    return ok("it ignores them")
