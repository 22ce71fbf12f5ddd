"""The stop of ``pebble estop``: sent at once, repeated until each robot has confirmed it, and reported in lines."""

from __future__ import annotations

import logging
import sys
import threading
import time
from contextlib import ExitStack, closing, suppress
from functools import partial

import typer

from pebble.config.visible import shown
from pebble.contract import CAPABILITIES, ESTOP_STATE, ONLINE, STATUS
from pebble.contract.identity import parse_topic
from pebble.contract.levels import LEVELS
from pebble.errors import TransportError
from pebble.extensions.operator.client.connection import (
    Listener,
    Target,
    connected,
    listening,
    me,
    put_account_into_topics,
    target_of,
    wait_for,
)
from pebble.extensions.operator.client.driveable import doubt_of, is_cut_off
from pebble.extensions.operator.client.estop import Progress, RobotStop, StopSender, new_name, send
from pebble.extensions.operator.client.heartbeats import Heartbeats
from pebble.extensions.operator.client.names import id_of, spellings
from pebble.extensions.operator.client.robot_topics import SYNONYMS
from pebble.extensions.operator.commands import show
from pebble.extensions.operator.notices import PrintingThread, or_undone
from pebble.transports import MqttSettings, QoS, State, Transport

log = logging.getLogger(__name__)

ANSWER_S = LEVELS["wide"].answer_s  # longest wait for what the broker has of a robot
NOTICE_S = 0.15  # without a connection, until a line says so; the program itself starts in 0.3 s
_TICK_S = 0.25
_HEARD_S = 0.02  # between two looks at heartbeats
_ON_ITS_WAY_S = 0.05  # between the thread that has received a message and this one
_REPORT_PERIOD_S = 0.05
_QUICK_S = 1.0  # an answer within this time needs no line before it
_OTHERS_S = 3.0  # for heartbeats of other robots
_NAMED = 8  # robots in one line
_BATCH = 1000  # messages that are handled before the next stop is due


def stop(robot: str | None, target: Target, why: str, *, hold: bool) -> int:
    """Send stops of one robot or, without one, of all; return the exit code.

    A stop of one robot waits for a connection, as a broker may be restarting. Robots of a broker that is not there
    cannot be found.
    """
    every = robot is None
    with ExitStack() as opened:
        with or_undone("STOP NOT SENT"):
            target = target_of(robot, target)
            connection = connected(target, needed=every, undone="the stop is NOT SENT YET", patience_s=NOTICE_S)
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
                report.say(f"stop {sender.order.name} is held until Ctrl-C; robots stay stopped after it")
            _repeat(robots or [names.base], sender, outbox, report)
        except KeyboardInterrupt:
            pass
        except Exception:
            log.exception("the stop is not repeated any more")
        sender.end()
        report.end()
    return 0 if sender.confirmed and not _any_cut_off(sender) else 1


def _repeat(bases: list[str], sender: StopSender, outbox: _Outbox, report: _Report) -> None:
    """Repeat stops until they are confirmed. Listen on a second connection: what arrives delays none of them."""
    every = not sender.order.named
    with ExitStack() as opened:
        heartbeats = _heartbeats(outbox.transport, opened) if every else None
        second = opened.enter_context(listening(outbox.transport))
        listener, subscribing = _listen(second, bases)
        others = None if every else _OtherRobots(outbox.transport, sender, opened, report)
        while not sender.finished:
            for message in heartbeats.take() if heartbeats else ():
                sender.receive(message, time.monotonic())
            outbox.publish()  # to robots that were just heard, before the wait
            _receive(listener, sender, _until_due(sender, has_heartbeats=heartbeats is not None))
            _drop_other_spelling(sender)
            outbox.publish()
            report.update(time.monotonic())
            if others is not None:
                with suppress(Exception):  # a line about other robots ends no repetition
                    others.look(time.monotonic())
        # wait for the robot's status, which may come last: by it the report says whether the motors obey
        subscribing.join(ANSWER_S)
        wait_for(lambda: second.state is State.CONNECTED, ANSWER_S)
        _receive(listener, sender, _ON_ITS_WAY_S)
        since = time.monotonic()  # a robot that has just started says for a moment that it is cut off
        while _any_cut_off(sender) and time.monotonic() < since + ANSWER_S:
            _receive(listener, sender, _ON_ITS_WAY_S)


def _any_cut_off(sender: StopSender) -> bool:
    """True if a robot says that no command reaches its motors."""
    return any(is_cut_off(robot.driveable) for robot in sender.robots.values())


def _heartbeats(transport: Transport, opened: ExitStack) -> Heartbeats | None:
    """Return another connection as ``transport``, for heartbeats of all robots, which ``opened`` closes.

    None with a client id from the config, with which there can be only one connection.
    """
    settings = transport.settings
    if not isinstance(settings, MqttSettings) or settings.client_id is not None:
        return None
    return opened.enter_context(closing(Heartbeats(settings)))


class _OtherRobots:
    """The robots that are heard while nothing comes from the one to be stopped: its name may be mistyped."""

    def __init__(self, transport: Transport, sender: StopSender, opened: ExitStack, report: _Report) -> None:
        self._transport, self._sender, self._opened, self._report = transport, sender, opened, report
        self._due = time.monotonic() + _QUICK_S
        self._heartbeats: Heartbeats | None = None

    def look(self, now: float) -> None:
        """Once nothing has come for long enough, listen to others; name them in one line a little later."""
        if now < self._due or any(robot.live or robot.estop.has_capabilities for robot in self._sender.robots.values()):
            return
        self._due = float("inf")
        if self._heartbeats is None:
            self._heartbeats = _heartbeats(self._transport, self._opened)
            if self._heartbeats is not None:
                self._due = now + _OTHERS_S
            return
        messages = self._heartbeats.take()
        threading.Thread(target=self._heartbeats.close, daemon=True).start()  # on a thin link no stop waits for more
        addresses = (parse_topic(message.topic) for message in messages if not message.retain)
        robots = {address.identity for address in addresses if address is not None and not address.identity.is_server}
        if robots and not any(robot.base in self._sender.robots for robot in robots):
            name, names = id_of(next(iter(self._sender.robots))), sorted(id_of(robot.base) for robot in robots)
            more = ", …" if len(names) > _NAMED else ""
            heard = f"heard here: {', '.join(names[:_NAMED])}{more}"
            self._report.say(f"pebble: nothing comes from {name}; {heard}", err=True)


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
    """A printer of a line whenever the stop of a robot makes progress. No stop waits for it."""

    def __init__(self, sender: StopSender, outbox: _Outbox) -> None:
        self._sender, self._outbox = sender, outbox
        self._lines: dict[str, str] = {}  # the last one of each robot
        self._problem = outbox.problem  # of which a line was printed
        self._began = self._updated = time.monotonic()
        self._printing = PrintingThread()

    def say(self, line: str, *, err: bool = False) -> None:
        """Print a line, which may have names from others."""
        self._printing.run(partial(_echo, shown(line), err=err))

    def update(self, now: float) -> None:
        """Print the lines that have changed, and warn once of an outage."""
        if now - self._updated < _REPORT_PERIOD_S:
            return
        self._updated = now
        problem = self._outbox.problem
        if problem and not self._problem:
            self.say(f"pebble: warning: nothing is sent until there is a connection: {problem}", err=True)
        self._problem = problem
        self._print(is_early=now - self._began < _QUICK_S)

    def end(self) -> None:
        """Print the last lines, and wait until all are printed."""
        sender = self._sender
        self._print(is_early=False)
        if not sender.robots:
            self.say("no robot was heard: NOTHING IS STOPPED")
        if sender.omitted:
            self.say(f"there are more than {len(sender.robots)} robots: the others got the stop, NOT CONFIRMED")
        self._printing.close()

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
                self.say(f"{id_of(base)}: {line}")


def _echo(line: str, *, err: bool) -> None:
    """Print ``line``; discard it if its reader has ended or a disk is full."""
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
