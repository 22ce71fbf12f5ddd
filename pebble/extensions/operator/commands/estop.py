"""``pebble estop``: stops robots until each has confirmed it, ends stops, and shows them."""

from __future__ import annotations

import difflib
import sys
import time
from contextlib import ExitStack, suppress
from functools import partial
from typing import Annotated

import typer

from pebble.config.visible import shown
from pebble.contract import CAPABILITIES, ESTOP_STATE, LINK, ONLINE, STATUS
from pebble.errors import PebbleError, TransportError
from pebble.extensions.operator.client.connection import (
    Target,
    connected,
    listening,
    me,
    put_account_into_topics,
    target_of,
    wait_for,
)
from pebble.extensions.operator.client.discovery import Discovery
from pebble.extensions.operator.client.driveable import Driveable, doubt_of
from pebble.extensions.operator.client.names import Names, id_of, spellings
from pebble.extensions.operator.client.robot_estop import Reset, RobotEstop
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.operator.commands import show
from pebble.extensions.operator.commands.repeated_stop import ANSWER_S, NOTICE_S, stop
from pebble.extensions.operator.commands.target import with_target
from pebble.extensions.operator.notices import noticed, or_undone
from pebble.extensions.operator.signals import interrupted_by_signals
from pebble.transports import Message, Transport

_VERBS = ("reset", "status")


@with_target(program="estop")
def estop(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            help="A robot's config file, or with --url or --config its id.",
            metavar="[reset|status] ROBOT",
            show_default=False,
        ),
    ] = None,
    all_: Annotated[bool, typer.Option("--all", help="Stop all robots there.")] = False,
    hold: Annotated[
        bool, typer.Option("--hold", help="Until Ctrl-C: also stop robots that come online meanwhile.")
    ] = False,
    why: Annotated[str, typer.Option(help="Shown to others; at most 40 characters.", metavar="TEXT")] = "",
    *,
    target: Target,
) -> int:
    """Stop robots until they are reset.

    This is software over a network, not a safety-rated stop: where people can be hurt, cut the power of the motors.

    A stopped robot moves nothing, also after a restart, until `pebble estop reset`. The stop is repeated until every
    motor owner of the robot has confirmed it, for at most a minute. Exit code 0: confirmed; 1: not confirmed, or the
    robot says that no command reaches its motors.

    \b
        pebble estop goob.json
        pebble estop goob.json --remote
        pebble estop goob --url mqtt://127.0.0.1 --why "dog on the lane"
        pebble estop --all --url mqtt://127.0.0.1
        pebble estop --all --hold --url mqtt://127.0.0.1
        pebble estop status --url mqtt://127.0.0.1
        pebble estop reset goob.json
    """
    verb, robot = _parse(words or [])
    if verb and (all_ or hold or why):
        raise typer.BadParameter(f"--all, --hold and --why are not for {verb}")
    if all_ and robot is not None:
        raise typer.BadParameter(f"give either --all or {robot}")
    if robot is None and not all_ and verb != "status":
        raise typer.BadParameter("name the robot" if verb else "nothing was stopped: name the robot, or add --all")
    if verb == "status":
        return _status(target_of(robot, target), every=robot is None)
    code = 1
    with suppress(KeyboardInterrupt), interrupted_by_signals():  # what was done by then is printed
        code = _reset(robot, target) if verb == "reset" else stop(robot, target, why, hold=hold)
    return code


def _parse(words: list[str]) -> tuple[str, str | None]:
    """Return verb and robot, as in ``("reset", "goob.json")``; the verb is empty for a stop."""
    verb = words[0] if words and words[0] in _VERBS else ""
    robots = words[1:] if verb else words
    near = difflib.get_close_matches(words[0], _VERBS, n=1) if len(words) > 1 and not verb else []
    if near:
        raise typer.BadParameter(f'did you mean "pebble estop {near[0]} {words[1]}"?')
    if len(robots) > 1:
        raise typer.BadParameter(f"one robot at a time{'' if verb else ', or --all'}: not {' '.join(robots)}")
    if robots and robots[0] in _VERBS:
        raise typer.BadParameter(f"a robot called {robots[0]} is given as system/type/id")
    return verb, robots[0] if robots else None


def _reset(robot: str | None, target: Target) -> int:
    """Show the robot's stops, ask, reset them, and wait for the answer."""
    with ExitStack() as opened:
        with or_undone("NOT RESET"):
            target = target_of(robot, target)
            connection = connected(target, undone="nothing is reset yet", patience_s=NOTICE_S)
            transport, names = opened.enter_context(connection)
            # Messages of the robot come on a connection of their own if possible: they do not delay the reset.
            receiving = opened.enter_context(listening(transport))
            with noticed(lambda: "waiting for the robot's stop states"):
                view = _viewed(transport, receiving, names)
            name = shown(id_of(view.estop.base))
            if not view.estop.states:
                raise PebbleError(f"{name} publishes no emergency stop: {_absent(view.estop)}")
            reset = Reset(view.estop, me(names.account))
            _print_states(view.estop)
            stops_to_reset = reset.shown  # those that are printed here, and no later ones
            if not stops_to_reset:
                return 0
            if sys.stdin.isatty() and not typer.confirm(f"Let {name} move again?"):
                return 1
        with or_undone(f"the reset of {name} is NOT CONFIRMED"):  # from now on some motor owners may be free
            for message in reset.messages():
                if not transport.publish(message.topic, message.payload, qos=message.qos, urgent=True):
                    raise TransportError(transport.problem or "the connection was lost")
            wait_for(lambda: not reset.waiting, view.pace.answer_s)
        if refusals := reset.refusals():
            owner, why = next(iter(refusals.items()))
            raise PebbleError(shown(f"{name} is still stopped: {owner}: {why}; look again, then repeat"))
    doubt, moves = doubt_of(view.driveable), "it moves again once drive commands have paused for half a second"
    typer.echo(shown(f"{name}: free; {f'its status says: {doubt}' if doubt else moves}"))
    return 0


def _viewed(transport: Transport, receiving: Transport, names: Names) -> RobotView:
    """Return the robot as its retained messages show it, once they have had time to arrive."""
    views = [RobotView(base) for base in spellings(names.base)]
    for view in views:
        view.estop.subscribe(receiving)
    wait_for(lambda: any(view.estop.has_capabilities for view in views), ANSWER_S)
    view = next((view for view in views if view.estop.has_capabilities), views[0])
    robot = view.estop

    def is_named(base: str) -> bool:
        """True if it is this robot, and it takes commands only at topics with the sender's name."""
        return base == robot.base and robot.named

    put_account_into_topics(transport, names, is_named)
    # LINK is for ``view.pace``, STATUS for ``view.driveable``. STATUS is the longer one: it must not delay the answers
    # to the reset, which come on ``receiving``.
    for channel, connection in ((LINK, receiving), (STATUS, transport)):
        take = partial(view.receive, channel, now=0.0, wall=0.0)  # neither depends on the time
        connection.subscribe(channel.topic(robot.base), take, direct=True)
    receiving.ask(robot.missing)  # stop states: the capabilities that list the owners may just have come
    wait_for(lambda: not robot.missing, ANSWER_S)
    return view


def _status(target: Target, *, every: bool) -> int:
    """Print the stop states of the target's robot or of every robot there, once they have had time to arrive."""
    with connected(target) as (transport, names):
        discovery = Discovery()

        def take(message: Message) -> None:
            discovery.receive(message, time.monotonic(), time.time())

        is_remote = target.remote or str(target.url).startswith("mqtt")  # within a robot there is no heartbeat
        of_robots = (ESTOP_STATE, STATUS, CAPABILITIES)
        for channel in (*of_robots, ONLINE, LINK) if is_remote else of_robots:
            transport.subscribe(channel.filter(names.base), take, direct=True)
        if not every:  # some brokers deliver a retained state only if its exact topic is asked for
            wait_for(lambda: any(robot.estop.has_capabilities for robot in discovery.all_robots()), ANSWER_S)
            transport.ask([topic for robot in discovery.all_robots() for topic in robot.estop.missing])
        if is_remote:
            began = time.monotonic()  # until each robot has sent a heartbeat, or counts as silent
            with noticed(lambda: "waiting for heartbeats"):
                wait_for(lambda: not discovery.awaits_heartbeat(time.monotonic() - began), float("inf"))
            wait_for(lambda: not any(robot.live and robot.estop.lacks for robot in discovery.all_robots()), ANSWER_S)
        robots = sorted(discovery.all_robots(), key=lambda robot: robot.base)
    for robot in robots:
        _print_states(robot.estop, robot.driveable, silent=is_remote and not robot.live)
    if not robots:
        typer.echo("no robot has published an emergency stop or capabilities")
    return 0 if robots else 1


def _print_states(robot: RobotEstop, driveable: Driveable | None = None, *, silent: bool = False) -> None:
    """Print one line if a robot is free or has no emergency stop, otherwise one for each stopped owner.

    ``silent``: it sends no heartbeat at present.
    """
    name, now = id_of(robot.base), time.time()
    if silent:
        name += ": no heartbeat; its last state"
    lines = [
        f"{name}: {show.stopped(state, now)} ({owner}{'' if state.persisted else ', NOT SAVED'})"
        for owner, state in robot.latched.items()
    ]
    missing = [owner for owner in robot.owners if owner not in robot.states]
    if robot.has_capabilities and not robot.available:
        lines.append(f"{name}: {_absent(robot)}")
    elif missing or not robot.states:
        lines.append(f"{name}: unknown, no state of {', '.join(missing) or 'any motor owner'}")
    lines = lines or [f"{name}: free"]
    if doubt := doubt_of(driveable, stopped=bool(robot.latched)):
        lines.append(f"{name}: {doubt}")
    for line in lines:
        typer.echo(shown(line))


def _absent(robot: RobotEstop) -> str:
    """Return why a robot has no emergency stop."""
    if robot.old:
        return "its firmware has none"
    if robot.has_capabilities and not robot.available:
        return "its broker refuses it" if robot.drives else "it does not drive"
    return "is it on, and is this its broker?"
