"""``pebble estop``: stops robots until each has confirmed it, ends stops, and shows them."""

from __future__ import annotations

import difflib
import getpass
import logging
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from typing import Annotated

import typer

from pebble.config.visible import shown
from pebble.contract import CAPABILITIES, ESTOP_STATE, LINK, ONLINE, STATUS
from pebble.contract.identity import parse_topic
from pebble.contract.levels import LEVELS
from pebble.errors import PebbleError, TransportError
from pebble.extensions.operator.client.connection import (
    Listener,
    Target,
    connected,
    in_small_segments,
    listening,
    put_account_into_topics,
    resolve,
    target_of,
    wait_for,
)
from pebble.extensions.operator.client.discovery import Discovery
from pebble.extensions.operator.client.driveable import Driveable, doubt_of, is_cut_off
from pebble.extensions.operator.client.estop import Progress, RobotStop, StopSender, new_name, send
from pebble.extensions.operator.client.estop_states import Reset, RobotEstop
from pebble.extensions.operator.client.heartbeats import Heartbeats
from pebble.extensions.operator.client.names import Names, id_of, spellings
from pebble.extensions.operator.client.robot_topics import SYNONYMS
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.operator.commands import show
from pebble.extensions.operator.commands.target import with_target
from pebble.extensions.operator.notices import noticed
from pebble.extensions.operator.signals import interrupted_by_signals
from pebble.transports import Message, MqttSettings, QoS, State, Transport

log = logging.getLogger(__name__)

_VERBS = ("reset", "status")
_TICK_S = 0.25
_HEARD_S = 0.02  # between two looks at heartbeats
_ON_ITS_WAY_S = 0.05  # between the thread that has received a message and this one
_REPORT_PERIOD_S = 0.05
_NOTICE_S = 0.15  # without a connection, until a line says so; the program itself starts in 0.3 s
_QUICK_S = 1.0  # an answer within this time needs no line before it
_OTHERS_S = 3.0  # for heartbeats of other robots
_NAMED = 8  # robots in one line
_ANSWER_S = LEVELS["wide"].answer_s  # longest wait for what the broker has of a robot
_BATCH = 1000  # messages that are handled before the next stop is due


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
        code = _reset(robot, target) if verb == "reset" else _stop(robot, target, why, hold=hold)
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


def me(account: str | None = None) -> str:
    """Return the sender of this command, such as ``ann@desk``: the account (without one, the user) at this machine."""
    try:
        user = account or getpass.getuser()
    except (ImportError, KeyError, OSError):  # no name for this user id, or no such ids
        user = "unknown"
    return f"{user}@{socket.gethostname()}"


# -- stop


@contextmanager
def _or_undone(undone: str) -> Iterator[None]:
    """Raise PebbleError that begins with ``undone`` instead of any error, and instead of an interrupt."""
    try:
        yield
    except (KeyboardInterrupt, typer.Abort):
        raise PebbleError(f"{undone}: interrupted") from None
    except PebbleError as error:
        raise PebbleError(f"{undone}: {error}") from None
    except Exception:
        log.exception("an unexpected error")
        raise PebbleError(f"{undone}: an unexpected error, see above") from None


def _stop(robot: str | None, target: Target, why: str, *, hold: bool) -> int:
    """Send stops of one robot or, without one, of all.

    A stop of one robot waits for a connection, as a broker may be restarting. Robots of a broker that is not there
    cannot be found.
    """
    every = robot is None
    with ExitStack() as opened:
        with _or_undone("STOP NOT SENT"):
            target = target_of(robot, target)
            connection = connected(target, needed=every, undone="the stop is NOT SENT YET", patience_s=_NOTICE_S)
            transport, names = opened.enter_context(connection)
            robots = None if every else spellings(names.base)
            by = me(names.account)
            sender = StopSender(new_name(), by=by, why=why, now=time.monotonic(), robots=robots, hold=hold)
            put_account_into_topics(
                transport, names, lambda base: base in sender.robots and sender.robots[base].estop.named
            )
        outbox = _Outbox(transport, sender)
        report = _Report(sender, outbox)
        try:
            outbox.publish()  # at once, before anything else
            if hold:
                _echo(f"stop {sender.order.name} is held until Ctrl-C; robots stay stopped after it")
            _repeat(target, robots or [names.base], sender, outbox, report)
        except KeyboardInterrupt:
            pass
        except Exception:
            log.exception("the stop is not repeated any more")
        sender.end()
        report.end()
    return 0 if sender.confirmed and not _any_cut_off(sender) else 1


def _repeat(target: Target, bases: list[str], sender: StopSender, outbox: _Outbox, report: _Report) -> None:
    """Repeat stops until they are confirmed. Listen on a second connection: what arrives delays none of them."""
    every = not sender.order.named
    with ExitStack() as opened:
        heartbeats = opened.enter_context(_heartbeats(target, every=every))
        second = opened.enter_context(listening(target, outbox.transport))
        listener, subscribing = _listen(second, bases)
        others = None if every else _OtherRobots(target, sender, opened)
        while not sender.finished:
            for message in heartbeats.take() if heartbeats else ():
                sender.receive(message, time.monotonic())
            outbox.publish()  # to robots that were just heard, before the wait
            _receive(listener, sender, _until_due(sender, has_heartbeats=heartbeats is not None))
            _drop_other_spelling(sender)
            outbox.publish()
            report.connection(outbox.problem)
            report.update(time.monotonic())
            if others is not None:
                others.look(time.monotonic())
        # wait for the robot's status, which may come last: by it the report says whether the motors obey
        subscribing.join(_ANSWER_S)
        wait_for(lambda: second.state is State.CONNECTED, _ANSWER_S)
        _receive(listener, sender, _ON_ITS_WAY_S)
        since = time.monotonic()  # a robot that has just started says for a moment that it is cut off
        while _any_cut_off(sender) and time.monotonic() < since + _ANSWER_S:
            _receive(listener, sender, _ON_ITS_WAY_S)


def _any_cut_off(sender: StopSender) -> bool:
    """True if a robot says that no command reaches its motors."""
    return any(is_cut_off(robot.driveable) for robot in sender.robots.values())


@contextmanager
def _heartbeats(target: Target, *, every: bool) -> Iterator[Heartbeats | None]:
    """Yield a connection for heartbeats if all robots of a broker are to be stopped (``every``), else None.

    It is None, too, with a client id from the config, with which there can be only one connection.
    """
    _, settings, _, _ = resolve(target)
    if not every or not isinstance(settings, MqttSettings) or settings.client_id is not None:
        yield None
        return
    with closing(Heartbeats(in_small_segments(settings))) as heartbeats:
        yield heartbeats


class _OtherRobots:
    """The robots that are heard while nothing comes from the one to be stopped: its name may be mistyped."""

    def __init__(self, target: Target, sender: StopSender, opened: ExitStack) -> None:
        self._target, self._sender, self._opened = target, sender, opened
        self._due = time.monotonic() + _QUICK_S
        self._heartbeats: Heartbeats | None = None

    def look(self, now: float) -> None:
        """Once nothing has come for long enough, listen to others; name them in one line a little later."""
        if now < self._due or any(robot.live or robot.estop.has_capabilities for robot in self._sender.robots.values()):
            return
        if self._heartbeats is None:
            with suppress(PebbleError):  # the config is gone
                self._heartbeats = self._opened.enter_context(_heartbeats(self._target, every=True))
            self._due = float("inf") if self._heartbeats is None else now + _OTHERS_S
            return
        self._due = float("inf")
        addresses = (parse_topic(message.topic) for message in self._heartbeats.take())
        names = sorted({id_of(address.identity.base) for address in addresses if address is not None})
        if names:
            name, more = id_of(next(iter(self._sender.robots))), ", …" if len(names) > _NAMED else ""
            _echo(shown(f"pebble: nothing comes from {name}; heard here: {', '.join(names[:_NAMED])}{more}"), err=True)


def _drop_other_spelling(sender: StopSender) -> None:
    """Stop no more the robot whose name only looks like that of the one that was heard."""
    heard = [base for base, robot in sender.robots.items() if robot.live or robot.progress is Progress.CONFIRMED]
    if sender.order.named and heard:
        sender.robots = {base: sender.robots[base] for base in heard}


def _listen(transport: Transport, bases: list[str]) -> tuple[Listener, threading.Thread]:
    """Subscribe on a thread, so that a slow network does not delay the stop; return the listener and the thread."""
    channels = (ESTOP_STATE, CAPABILITIES, STATUS, ONLINE, *SYNONYMS)
    filters = [channel.filter(base) for base in bases for channel in channels]
    listener = Listener(transport, ())

    def subscribe() -> None:
        with suppress(TransportError):  # closed meanwhile
            listener.subscribe(transport, filters)

    subscribing = threading.Thread(target=subscribe, name="pebble-estop-subscribe", daemon=True)
    subscribing.start()
    return listener, subscribing


def _until_due(sender: StopSender, *, has_heartbeats: bool) -> float:
    """Return how many seconds to wait for messages: fewer while the heartbeats' connection may show new robots."""
    most_s = _HEARD_S if has_heartbeats and sender.collecting else _TICK_S
    return most_s if sender.due is None else min(most_s, sender.due - time.monotonic())


def _receive(listener: Listener, sender: StopSender, wait_s: float) -> None:
    """Handle the messages that have arrived; if there is none, wait up to ``wait_s`` seconds for one."""
    for _ in range(_BATCH):
        message = listener.next(wait_s)
        if message is None:
            return
        sender.receive(message, time.monotonic())
        wait_s = 0.0


class _Outbox:
    """A publisher of a stop. It knows to which robots the stop was sent."""

    def __init__(self, transport: Transport, sender: StopSender) -> None:
        self.transport, self._sender = transport, sender
        self._waiting: set[str] = set()  # robots whose stop the transport has accepted
        self._sent: set[str] = set()  # robots whose stop has left it

    @property
    def problem(self) -> str:
        """Return why there is no connection; empty if there is one."""
        return "" if self.transport.state is State.CONNECTED else self.transport.problem or "no connection"

    def publish(self) -> None:
        send(self._accepts, self._sender.tick(time.monotonic()))  # waits for no acknowledgement

    def has_sent(self, base: str) -> bool:
        """True if a stop of this robot has reached the other end of the connection."""
        if self.transport.state is State.CONNECTED and not self.transport.outgoing.waiting:
            self._sent |= self._waiting
            self._waiting.clear()
        return base in self._sent

    def _accepts(self, topic: str, payload: bytes, *, qos: QoS) -> bool:
        accepted = self.transport.publish(topic, payload, qos=qos, urgent=True)
        if accepted and topic.count("/") > 2:
            self._waiting.add("/".join(topic.split("/", 3)[:3]))  # the robot's base topic
        return accepted


class _Report:
    """A printer of a line whenever the stop of a robot makes progress."""

    def __init__(self, sender: StopSender, outbox: _Outbox) -> None:
        self._sender, self._outbox = sender, outbox
        self._lines: dict[str, str] = {}  # the last one of each robot
        self._problem = outbox.problem  # of which a line was printed
        self._began = self._updated = time.monotonic()

    def connection(self, problem: str) -> None:
        """Warn of an outage, once."""
        if problem and not self._problem:
            _echo(f"pebble: warning: nothing is sent until there is a connection: {problem}", err=True)
        self._problem = problem

    def update(self, now: float) -> None:
        if now - self._updated >= _REPORT_PERIOD_S:
            self._updated = now
            self._print(is_early=now - self._began < _QUICK_S)

    def end(self) -> None:
        sender = self._sender
        self._print(is_early=False)
        if not sender.robots:
            _echo("no robot was heard: NOTHING IS STOPPED")
        if sender.omitted:
            _echo(f"there are more than {len(sender.robots)} robots: the others got the stop, NOT CONFIRMED")

    def _print(self, *, is_early: bool) -> None:
        """Print the lines that have changed; ``is_early``: see :func:`_line`."""
        for base, robot in list(self._sender.robots.items()):
            if is_early and robot.driveable is None and robot.progress is Progress.CONFIRMED:
                continue  # its status may be on its way, and say that no stop reaches the motors
            unsent = "" if self._outbox.has_sent(base) else self._outbox.problem or "the broker has not acknowledged it"
            line = _line(robot, is_early=is_early, unsent=unsent)
            if line and (doubt := doubt_of(robot.driveable, stopped=True)):
                line += f"; {doubt}"
            if self._lines.get(base, "") != line:
                self._lines[base] = line
                _echo(shown(f"{id_of(base)}: {line}"))


def _echo(line: str, *, err: bool = False) -> None:
    """Print ``line``. If that fails, because the reader has ended or a disk is full, the stop is sent all the same."""
    try:
        typer.echo(line, err=err)
    except OSError:
        show.discard_output(sys.stderr if err else sys.stdout)


def _line(robot: RobotStop, *, is_early: bool, unsent: str) -> str:
    """Return the progress of the stop of a robot in words.

    While it ``is_early``, no answer is called missing. ``unsent``: why no stop has left yet; empty if it has.
    """
    match robot.progress:
        case Progress.CONFIRMED if not robot.estop.latched:
            return "was stopped, and reset since"
        case Progress.CONFIRMED:
            held = "stopped and confirmed" if robot.saved else "stopped"
            if is_cut_off(robot.driveable):
                held = f"latched, confirmed by {', '.join(robot.estop.owners)}"
            unsaved = ", not saved yet" if robot.sending else ", NOT SAVED: a restart frees it"
            return f"{held} after {robot.confirmed_s:.2f} s{'' if robot.saved else unsaved}"
        case Progress.OLD if robot.sending:
            return "old firmware: zeros are sent, it cannot be latched"
        case Progress.OLD:
            return "old firmware: NOT LATCHED, zeros are no longer sent"
        case Progress.SPARED:
            return "does not drive"
        case Progress.NOT_CONFIRMED if unsent:
            return f"STOP NOT SENT: {unsent}"
        case Progress.NOT_CONFIRMED:
            return f"NOT CONFIRMED, no longer sent: {_why(robot)}"
    if is_early:
        return "" if unsent else "stop sent"
    if unsent:
        return f"STOP NOT SENT YET: {unsent}"
    return f"stop sent, not confirmed yet: {_why(robot)}"


def _why(robot: RobotStop) -> str:
    if not robot.is_gone:
        return robot.why
    when = time.strftime(" on %Y-%m-%d at %H:%M:%S", time.localtime(robot.stamp)) if robot.stamp else ""
    return f"it was last seen under this name{when}, is offline, and may be called otherwise now"


# -- reset and status


def _reset(robot: str | None, target: Target) -> int:
    """Show the robot's stops, ask, reset them, and wait for the answer."""
    with ExitStack() as opened:
        with _or_undone("NOT RESET"):
            target = target_of(robot, target)
            connection = connected(target, undone="nothing is reset yet", patience_s=_NOTICE_S)
            transport, names = opened.enter_context(connection)
            # Messages of the robot come on a connection of their own if possible: they do not delay the reset.
            receiving = opened.enter_context(listening(target, transport))
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
            for message in reset.messages():
                if not transport.publish(message.topic, message.payload, qos=message.qos, urgent=True):
                    raise TransportError(transport.problem or "the connection was lost")
        with _or_undone(f"the reset of {name} is NOT CONFIRMED"):
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
    wait_for(lambda: any(view.estop.has_capabilities for view in views), _ANSWER_S)
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
    wait_for(lambda: not robot.missing, _ANSWER_S)
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
            wait_for(lambda: any(robot.estop.has_capabilities for robot in discovery.all_robots()), _ANSWER_S)
            transport.ask([topic for robot in discovery.all_robots() for topic in robot.estop.missing])
        if is_remote:
            began = time.monotonic()  # until each robot has sent a heartbeat, or counts as silent
            with noticed(lambda: "waiting for heartbeats"):
                wait_for(lambda: not discovery.awaits_heartbeat(time.monotonic() - began), float("inf"))
            wait_for(lambda: not any(robot.live and robot.estop.lacks for robot in discovery.all_robots()), _ANSWER_S)
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
