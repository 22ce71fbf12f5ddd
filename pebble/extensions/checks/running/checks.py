"""The table of checks of a running robot, with the connections that each needs."""

from __future__ import annotations

import math
import shlex
from itertools import pairwise

from pebble.check_result import CheckResult, failed, ok, skipped, warn
from pebble.contract.levels import LEVELS, silent_after
from pebble.extensions.checks.check import Check, some_of
from pebble.extensions.checks.observer import available, why_not_free
from pebble.extensions.checks.running import machine
from pebble.extensions.checks.running.operating import received, retained_commands, stop, wheels
from pebble.extensions.checks.running.robot import RobotSide, RobotUnderTest
from pebble.extensions.operator.client.names import id_of
from pebble.extensions.operator.client.robot_topics import section_of
from pebble.launcher.capabilities import capabilities as expected_capabilities
from pebble.runtime.addresses import Addresses
from pebble.runtime.notes import OFTEN

_IN_A_ROW = 10  # heartbeats in a row
_LONGEST_GAP = 2.5  # times the interval that its config has
_JUDGED_S = 6.0  # for the judgement whether motors obey: motor owners repeat every 5 s what it is based on
_VOLTS_S = 6.0  # boards report it every five seconds
_LOW_S = 2 * _VOLTS_S  # one reading is no empty battery
_LOW_CELL_V = 3.74  # of a lithium cell: 20 %, below which the page warns, too
_LEAST_CELL_V = 3.4  # below, a robot has minutes
_SHOWN = 5  # names in one line
_LOG = "journalctl -u pebble -n 50"

# -- what a check needs: empty, or why it is lacking


def running(robot: RobotUnderTest) -> str:
    if robot.own is None:
        return "its own side is not reached"
    states = set(_states(robot).values())
    return "it does not run" if states and states <= {"stopped"} else ""


def operators_side(robot: RobotUnderTest) -> str:
    return "" if robot.operators is not None else f"its operators' side is not reached: {robot.why_operators}"


def motors(robot: RobotUnderTest) -> str:
    return "" if robot.config.motor_owners else "it has no motors"


def account(robot: RobotUnderTest) -> str:
    nameless = robot.operators is not None and robot.view.named and not robot.operators.account
    return "at level named it needs an account: services.mqtt_bridge.remote_mqtt.username" if nameless else ""


def free(robot: RobotUnderTest) -> str:
    return why_not_free(robot.view)


# -- the sides


def processes(robot: RobotUnderTest) -> CheckResult:
    """Check that the robot answers on its own transport, and that each of its processes is ready."""
    if why := robot.why_own or running(robot):  # why_own: its own transport could not be reached
        return failed(why, "sudo systemctl start pebble, or pebble up CONFIG; and test it as the robot's user or root")
    if not robot.wait(lambda: _unready(robot) == [], robot.patience_s):
        return failed(", ".join(_unready(robot)), _LOG)
    services = section_of(robot.own_side.status, "services")
    restarting = [name for name in services if _is_often(section_of(services, name), "restarts")]
    if restarting:
        return failed(f"{', '.join(restarting)} ended {OFTEN} times within a minute, or more often", _LOG)
    return ok(f"{len(_states(robot))} are ready")


def _is_often(section: dict[str, object], event: str) -> bool:
    """True if a section of the status counts more events a minute than are normal."""
    count = section.get(f"{event}_per_minute")
    return isinstance(count, int) and count >= OFTEN


def _states(robot: RobotUnderTest) -> dict[str, str]:
    status = robot.own_side.status
    return {name: str(section_of(status, f"services.{name}").get("state")) for name in section_of(status, "services")}


def _unready(robot: RobotUnderTest) -> list[str]:
    """Return the programs that should be ready and are not.

    Held ones wait while a person drives; those on demand wait for a request: neither counts.
    """
    if not robot.own_side.status:
        return ["its status has not arrived: is it starting?"]
    states = {name: state for name, state in _states(robot).items() if state not in ("ready", "held")}
    return [f"{name} is {states[name]}" for name in sorted(states.keys() - {*robot.config.on_demand_programs()})]


def heartbeats(robot: RobotUnderTest) -> CheckResult:
    """Check that operators receive its heartbeats without gaps."""
    side, section = robot.operators, robot.config.services.mqtt_bridge.heartbeat
    if side is None:  # why_operators: why it could not be reached
        why = robot.why_operators
        return failed(why, "pebble doctor CONFIG") if robot.config.services.mqtt_bridge.enabled else skipped(why)
    if not section.enabled:
        return skipped("services.mqtt_bridge.heartbeat is off")

    liveness = side.view.liveness

    def longest() -> float:
        """Return the longest gap that is allowed on the link as it is now."""
        interval_s = max(section.interval_seconds, LEVELS[liveness.link].heartbeat_s)
        return max(
            silent_after(interval_s, liveness.link, liveness.average_latency_s or 0.0), _LONGEST_GAP * interval_s
        )

    if not robot.wait(lambda: side.heartbeats, robot.patience_s):
        return failed("none arrives", "pebble doctor CONFIG")
    if not robot.wait(lambda: _gap(side) <= longest(), 3 * _IN_A_ROW * longest()):
        return failed(f"gaps of {_gap(side):.1f} s, where {longest():.1f} s is the longest", "pebble doctor CONFIG")
    late = liveness.average_latency_s
    shown = "" if late is None else f", {1000 * late:.0f} ms on the way"
    return ok(f"{_IN_A_ROW} in a row, the longest gap {_gap(side):.2f} s{shown}")


def _gap(side: RobotSide) -> float:
    """Return the longest gap between the newest heartbeats; inf if there are too few."""
    newest = side.heartbeats[-_IN_A_ROW:]
    gaps = [after - before for before, after in pairwise(newest)]
    return max(gaps) if len(newest) == _IN_A_ROW else math.inf


def capabilities(robot: RobotUnderTest) -> CheckResult:
    """Check that the capabilities on both sides list what the config has."""
    wanted = {*available(expected_capabilities(robot.config, Addresses(robot.config)))}
    wanted.discard("outlets")  # they are known only while their MCU is connected
    for side in robot.sides:
        where = "" if side.own else " to operators"
        if not side.view.estop.has_capabilities:
            return failed(f"it has not published them{where}", _LOG)
        if lacking := sorted(wanted - {*available(side.view.capabilities)}):
            return failed(f"it does not offer {', '.join(lacking)}{where}", _LOG)
    return ok(", ".join(sorted(wanted)) or "none")


# -- what hangs on it


def boards(robot: RobotUnderTest) -> CheckResult:
    """Check that each serial line's board was heard, and that commands reach the motors."""
    lines = {name or "serial": line.serial.port for name, line in robot.config.serial_instances().items()}
    if not lines:
        return skipped("it has no serial line")

    def absent() -> list[str]:
        return [name for name in lines if _mcu(robot, name).get("state") != "ready"]

    robot.wait(lambda: not absent(), robot.patience_s)
    if names := absent():
        mcu = _mcu(robot, names[0])
        why = mcu.get("why") or _MCU_STATES.get(str(mcu.get("state")), "its state is not known")
        return failed(f"{names[0]} ({lines[names[0]]}): {why}", f"plug it in, then: pebble doctor CONFIG; {_LOG}")
    robot.wait(lambda: robot.view.driveable is None or robot.view.driveable.state != "unknown", _JUDGED_S)
    mcus = {name: _mcu(robot, name) for name in lines}
    restarting = [f"{name}: {mcu.get('why')}" for name, mcu in mcus.items() if _is_often(mcu, "starts")]
    if restarting:
        return failed(", ".join(restarting), "look at its supply while motors start, and at its cable")
    drives = robot.view.driveable
    if drives is not None and drives.state == "no":
        return failed(f"its motors are not reached: {drives.why}", _LOG)
    ages_ms = {name: mcu.get("heard_ms") for name, mcu in mcus.items()}
    unheard = [name for name, age_ms in ages_ms.items() if not isinstance(age_ms, int) or age_ms >= 10_000]
    if unheard:
        return skipped(f"{', '.join(unheard)} sends nothing at rest, as some boards do")
    if drives is not None and drives.state == "unknown":
        return skipped(f"it is not known whether its motors obey: {drives.why}")
    return ok(f"heard: {', '.join(lines)}" + (", and commands reach the motors" if drives is not None else ""))


_MCU_STATES = {"silent": "its board has stopped sending", "absent": "there is no such device", "booting": "it starts"}


def _mcu(robot: RobotUnderTest, name: str) -> dict[str, object]:
    """Return the part of the newest status about the board of a serial line."""
    return section_of(section_of(robot.own_side.status, "mcu"), name)


def battery(robot: RobotUnderTest) -> CheckResult:
    """Report the battery's voltage; warn if it stays low for the config's number of cells, fail if nearly empty."""
    robot.wait(lambda: robot.view.volts is not None, _VOLTS_S)
    volts, cells = robot.view.volts, robot.config.robot.battery_cells
    if volts is None:
        return skipped("it reports no voltage")

    def is_enough() -> bool:
        return (robot.view.volts or 0.0) >= (cells or 0) * _LOW_CELL_V

    charging = ", on the charger" if robot.view.charging else ""
    if cells and not charging and not robot.wait(is_enough, _LOW_S):
        volts = robot.view.volts or 0.0
        text = f"{volts:.2f} V, {volts / cells:.2f} V a cell"
        if volts < cells * _LEAST_CELL_V:
            return failed(f"{text}: it is nearly empty", "charge it")
        return warn(f"{text}: it is below 20 %", "charge it soon")
    return ok(f"{robot.view.volts:.2f} V{charging}")


def leftovers(robot: RobotUnderTest) -> CheckResult:
    """Find retained messages of other robot ids on this machine, such as those from before a robot was renamed."""
    local_sides = [side for side in robot.sides if side.is_here(robot.config)]
    if not local_sides:
        return skipped("other ids at a broker elsewhere are other robots")
    others: set[str] = set()
    for side in local_sides:
        topics, live = side.others()
        others |= topics.keys()
        if absent := sorted(topics.keys() - live):
            names = some_of([id_of(base) for base in absent], _SHOWN)
            remote = "" if side.own else " --remote"
            topic = shlex.quote(min(topics[absent[0]]))  # anybody may have chosen it
            fix = f"if they are gone: pebble topic pub {topic} '' --retain --force -c CONFIG{remote}, and so on"
            return failed(f"{len(absent)} that send no heartbeat: {names}", fix)
    return ok(f"none; {len(others)} other robots are there" if others else "none")


_BOTH = (running, operators_side)
CHECKS: tuple[Check[RobotUnderTest], ...] = (
    Check("unit", machine.unit),
    Check("slot", machine.slot),
    Check("clock", machine.clock),
    Check("disk", machine.disk),
    Check("processes", processes),
    Check("heartbeats", heartbeats),
    Check("capabilities", capabilities, (running,)),
    Check("boards", boards, (running,)),
    Check("battery", battery, (running, motors)),
    Check("leftovers", leftovers, (running,)),
    Check("page", machine.page),
    Check("picture", lambda robot: received(robot, "video", "camera"), (*_BOTH, account)),
    Check("sound", lambda robot: received(robot, "audio", "microphone"), (*_BOTH, account)),
    Check("retained commands", retained_commands, (*_BOTH, account, motors, free)),
    Check("stop", stop, (running, motors, free)),
)
#: What turns wheels: only where a person has agreed.
MOVING: tuple[Check[RobotUnderTest], ...] = (Check("wheels", wheels, (running, account, motors, free)),)
