"""The end of a schedule: everything works again, and then a script drives, and what ends it ends it at once."""

from __future__ import annotations

import signal
from collections.abc import Callable

from pebble.extensions.scripts.config import AutonomyManager
from tests.robot.lockstep.commands import PERSON
from tests.robot.lockstep.scripts import Script
from tests.robot.lockstep.world import STOP_TIMEOUT_S, World

_RESETS = 3  # looks and resets of a person; what others send may arrive in between
_ANSWER_S = 0.5
_SILENCE_S = 2.3  # of persons, until a script may drive
_MOVES_S = 0.8  # from a start to the first command
_AT_REST_S = 0.02  # from a stop to wheels at rest, where nothing is slow
_END_S = 2.1  # a script that is busy may take
_STEP_S = 0.005
_SHORT_S = 0.6  # a script that is late has not driven by then


def rest(world: World) -> None:
    """Raise ViolatedError unless the robot can be used as if nothing had happened."""
    _mend(world)
    _clear(world)
    person = world.people[0]
    before = world.script_rules.newest_run
    person.start("steady")
    world.scheduler.run(_MOVES_S)
    script = world.manager.newest
    world.scheduler.check(script is not None and script.run > before and script.alive, "a script cannot be started")
    assert script is not None
    status = person.status
    world.scheduler.check(
        status is not None and status.running and status.pid == script.pid, "the status does not show the script"
    )
    world.scheduler.check(_driven_by(world, script), "a script does not drive")
    _ENDS[world.layout % len(_ENDS)](world, script)


def _mend(world: World) -> None:
    if world.network.era is None:
        world.network.start()
    for process in (world.owner, world.manager, *world.people, *world.manager.alive_scripts, *world.by_hand):
        process.delay = 0.0
        process.thaw()
        process.slow_down(0.0)
    world.scheduler.run(3.2)  # what freezes, is killed or away for some time is back


def _clear(world: World) -> None:
    """Old scripts end, stops are reset, and persons are silent."""
    for script in world.by_hand:
        script.signal(signal.SIGKILL)
    for process in world.manager.alive_scripts:
        process.thaw()
    world.people[1].end_script()
    world.scheduler.run(2 * STOP_TIMEOUT_S + _ANSWER_S)
    world.scheduler.check(not world.manager.alive_scripts, "a script does not end")
    world.scheduler.check(not _turning(world), "the wheels turn though nobody drives")
    for _ in range(_RESETS):
        world.people[0].reset()
        world.scheduler.run(_ANSWER_S)
    world.scheduler.check(not world.wheel_rules.latched, "a stop cannot be reset")
    world.scheduler.run(_SILENCE_S)
    status = world.people[0].status
    world.scheduler.check(status is not None and not status.running, "the status shows a script though there is none")


def _driven_by(world: World, script: Script) -> bool:
    command = world.wheel_rules.turning()
    return command is not None and command.run == script.run


def _turning(world: World) -> bool:
    return world.wheel_rules.turning() is not None


def _ends(world: World, script: Script, error: str | None) -> None:
    """The wheels are at rest at once and stay so, the script ends, and the status says why."""
    world.scheduler.run(_AT_REST_S)
    world.scheduler.check(not _turning(world), "the wheels are not at rest soon after the end of a script")
    for _ in range(round(_END_S / 0.1)):
        world.scheduler.run(0.1)
        world.scheduler.check(not _turning(world), "the wheels turn again after the end of a script")
    world.scheduler.check(not script.alive, "a script does not end")
    status = world.people[0].status
    world.scheduler.check(status is not None and not status.running, "the status shows a script that has ended")
    assert status is not None
    known = error is None or world.config.section(AutonomyManager).on_override == "stop"
    world.scheduler.check(known or error in (status.error or ""), "the status does not say why the script has ended")


def _halt(world: World, script: Script) -> None:
    world.people[1].let_go_of_the_stick(final=True)
    _ends(world, script, "stopped by an operator")


def _zero_while_it_drives(world: World, script: Script) -> None:
    world.people[1].let_go_of_the_stick(final=False)
    _ends(world, script, "stopped by an operator")


def _emergency_stop(world: World, script: Script) -> None:
    world.people[1].press("ffff0000ffff0000")
    _ends(world, script, "emergency stop")


def _end(world: World, script: Script) -> None:
    world.people[1].end_script()
    _ends(world, script, None)


def _kill(world: World, script: Script) -> None:
    script.signal(signal.SIGKILL)
    _ends(world, script, "ended by signal 9")


def _lose(world: World, script: Script) -> None:
    """A person drives, and the connection is lost."""
    world.people[1].command()
    world.scheduler.run(0.75 + _STEP_S)
    world.scheduler.check(not _turning(world), "the wheels turn after a person's command was lost")
    world.scheduler.run(1.2)
    world.scheduler.check(not _turning(world), "the wheels turn after a person's command was lost")
    _ends(world, script, "stopped by an operator")


def _release(world: World, script: Script) -> None:
    """A person drives and lets go: the script goes on, unless the config says that it ends."""
    world.people[1].steer_to(0.3, 0, None)
    world.scheduler.run(0.1)
    command = world.wheel_rules.turning()
    world.scheduler.check(command is not None and command.run == PERSON, "a person does not drive")
    world.scheduler.run(0.3 + _AT_REST_S)
    world.scheduler.check(not _turning(world), "the wheels turn after a person has let go")
    if world.config.section(AutonomyManager).on_override == "stop":
        _ends(world, script, "stopped by an operator")
        return
    world.scheduler.run(2.2)
    world.scheduler.check(_driven_by(world, script), "a script does not resume after a person has let go")


def _halt_before_it_drives(world: World, _: Script) -> None:
    """A person stops a script that has not driven yet."""
    world.people[0].start("late")
    world.scheduler.run(_SHORT_S)
    script = world.manager.newest
    assert script is not None
    world.people[1].let_go_of_the_stick(final=True)
    _ends(world, script, "stopped by an operator")


def _restart_the_manager(world: World, script: Script) -> None:
    world.manager.kill(0.05)
    _ends(world, script, None)


_ENDS: tuple[Callable[[World, Script], None], ...] = (
    *(_halt, _release, _end, _kill, _lose, _emergency_stop, _zero_while_it_drives, _release, _restart_the_manager),
    _halt_before_it_drives,
)
