"""``pebble replay``: publishes a recording again, harmlessly unless asked for more."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pebble.config.visible import shown
from pebble.errors import PebbleError
from pebble.extensions.operator.client.connection import password
from pebble.extensions.operator.client.terminal.key_decoder import END, LEFT, RIGHT, SPACE
from pebble.extensions.operator.client.terminal.keys import Terminal, has_terminal, opened
from pebble.extensions.operator.client.url import settings_of
from pebble.extensions.operator.commands.options import CaCert, PasswordFile
from pebble.extensions.operator.signals import handled_by
from pebble.extensions.recordings.catalogue import check_name, look_at
from pebble.extensions.recordings.commands.options import Since, Until, period
from pebble.extensions.recordings.commands.report import report_unread
from pebble.extensions.recordings.library import files, problems
from pebble.extensions.recordings.replay.pace import FASTEST, SLOWEST
from pebble.extensions.recordings.replay.player import BusOutput, Player
from pebble.extensions.recordings.replay.robots import Make, ReplayedRobots
from pebble.extensions.recordings.replay.rules import SYSTEM, Options, Rules
from pebble.extensions.recordings.replay.source import ReplaySource
from pebble.transports import Message, Transport, create
from pebble.transports.topics import matches

_KEYS = "Space pauses, ← and → go 10 s back and on, + and - change the speed, Ctrl-C ends."
_STEP_NS = 10 * 10**9
_FASTER = 2.0
_WITH_COMMANDS = 1.0  # the lowest speed: a drive command moves a robot until the next one

RecordingsArgument = Annotated[
    list[Path], typer.Argument(help="Recordings, or folders of them.", metavar="FILE|FOLDER…", show_default=False)
]
UrlOption = Annotated[
    str,
    typer.Option(
        "--url", help="mqtt://[USER@]HOST[:PORT], mqtts://… or zenoh:RUN_DIR.", metavar="URL", show_default=False
    ),
]


Base = Annotated[str | None, typer.Option(help=f"First level of the new topics. [default: {SYSTEM}]", metavar="SYSTEM")]
Speed = Annotated[float, typer.Option(min=SLOWEST, max=FASTEST, help="1: as it was.")]
Loop = Annotated[bool, typer.Option("--loop", help="Begin again at the end.")]
Paused = Annotated[bool, typer.Option("--paused", help="Wait for the space key.")]
Only = Annotated[
    list[str] | None, typer.Option(help="Only recorded topics that match; may be repeated.", metavar="FILTER")
]
Incoming = Annotated[bool, typer.Option("--incoming", help="Drive commands of people, lights and sounds as well.")]


def replay(
    recordings: RecordingsArgument,
    url: UrlOption,
    base: Base = None,
    speed: Speed = 1.0,
    since: Since = None,
    until: Until = None,
    loop: Loop = False,
    paused: Paused = False,
    only: Only = None,
    incoming: Incoming = False,
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
) -> int:
    """Publish a recording again, at its pace.

    It appears under other topics, `replay/` for `pebble/`, without any command, and nothing of it is retained. At the
    end its robots are published as offline; if the process is killed, the broker does it. A replay stops no robot and
    resets no emergency stop, whatever the options.

    With a terminal: space pauses, the arrows go 10 s back and on, + and - change the speed. Ctrl-C ends.

    \b
        pebble replay walk.mcap --url mqtt://127.0.0.1
        pebble replay recordings --url mqtt://broker --since 10:00 --speed 4
        pebble replay walk.mcap --url mqtt://127.0.0.1 --base test --incoming
    """
    options = Options(system=base or SYSTEM, incoming=incoming, only=tuple(only or ()))
    if paused and not has_terminal():
        raise PebbleError("--paused needs a terminal, whose space key goes on")
    if incoming and speed < _WITH_COMMANDS:
        raise PebbleError(f"--speed {speed:g} would drive a robot for longer than it was: leave out --incoming")
    connection = settings_of(url, password=password(password_file), password_file=password_file, ca_cert=ca_cert)
    since_ns, until_ns = period(since, until)
    source, rules = _read(recordings, options)
    slowest, console = _WITH_COMMANDS if incoming else SLOWEST, _Console()
    make_player = partial(
        Player, source, rules.publishes, now=time.monotonic, wait=console.wait,
        since_ns=since_ns, until_ns=until_ns, speed=speed, slowest=slowest, loop=loop, paused=paused,
    )  # fmt: skip
    player = _play(console, _maker(*connection), rules, make_player)
    typer.echo(f"{player.sent} sent, {player.skipped} skipped")
    unread = report_unread(problems(source.damages))
    return unread if console.ended in ("", "SIGINT", END) else 1


def _read(recordings: list[Path], options: Options) -> tuple[ReplaySource, Rules]:
    """Return the recording to replay. Raises PebbleError if it has no messages to replay."""
    paths = files(recordings)
    source = ReplaySource(paths)
    topics = {channel.topic for channel in source.channels if not channel.topic.startswith("$")}
    rules = Rules(options, source.channels)
    for filter_ in () if problems(source.damages) else options.only:
        if not any(matches(filter_, topic) for topic in topics):
            check_name("topic", filter_, topics, recordings)
    if not rules.robots:
        report_unread(problems(source.damages))
        raise PebbleError("there is nothing to publish in this recording; see --only and --incoming")
    if missing := sum(look_at(path).missing for path in paths):
        typer.echo(f"pebble: {missing:,} messages are missing in this recording: files were damaged", err=True)
    return source, rules


def _play(console: _Console, make: Make, rules: Rules, make_player: Callable[..., Player]) -> Player:
    """Replay for these robots until the end. Raises TransportError."""
    terminal, bases = has_terminal(), list(rules.robots)
    with ExitStack() as stack:
        stack.enter_context(handled_by(console.on_signal))
        robots = ReplayedRobots(make, bases, wall_ms=lambda: time.time_ns() // 1_000_000)
        player = make_player(BusOutput(rules, stack.enter_context(robots).publish, time.time_ns))
        typer.echo(f"{', '.join(map(shown, bases))}{': ' + _KEYS if terminal else ''}")
        sys.stdout.flush()
        if terminal:
            stack.enter_context(console.keys())
        console.player, console.robots = player, robots
        if console.ended:
            player.stop()
        player.run()
    return player


def _maker(kind: str, settings: object) -> Make:
    def make(name: str, will: Message | None) -> Transport:
        return create(kind, name.replace("/", "-"), settings, will=will)

    return make


class _Console:
    """A terminal for the player: while the player waits it reads keys and signals, and shows the connection's state."""

    player: Player  # both are there once it plays
    robots: ReplayedRobots

    def __init__(self) -> None:
        self.ended = ""  # why, if not by the end of the recording
        self._terminal: Terminal | None = None
        self._problem = ""

    @contextmanager
    def keys(self) -> Iterator[None]:
        with opened() as terminal:
            self._terminal = terminal
            try:
                yield
            finally:
                self._terminal = None

    def wait(self, seconds: float) -> None:
        player, robots = self.player, self.robots
        if self._terminal is None:
            time.sleep(seconds)
            self._report(robots.problem)
        else:
            for key in self._terminal.keys(seconds):
                self._press(key, player)
            self.ended = self.ended or self._terminal.ended
            self._terminal.show(lambda: status(player, robots.problem), at_once=False)
        if self.ended and not player.ended:
            player.stop()

    def _report(self, problem: str) -> None:
        """Print a line for each change if there is no status line."""
        if problem != self._problem:
            self._problem = problem
            typer.echo(f"pebble: {shown(problem) or 'it goes on'}", err=True)

    def on_signal(self, number: int, _frame: object) -> None:
        """End the replay.

        Later signals are ignored until everything is cleaned up.
        """
        self.ended = self.ended or signal.Signals(number).name

    def _press(self, key: str, player: Player) -> None:
        if key == SPACE:
            (player.resume if player.paused else player.pause)()
        elif key in (LEFT, RIGHT):
            player.seek(player.position_ns + (_STEP_NS if key == RIGHT else -_STEP_NS))
        elif key in ("+", "="):
            player.speed *= _FASTER
        elif key == "-":
            player.speed /= _FASTER


def status(player: Player, problem: str) -> str:
    """Return the status line: time in the recording, speed, and number of sent messages."""
    moment = datetime.fromtimestamp(player.position_ns / 1e9).astimezone()
    doing = problem or ("paused" if player.paused else f"× {player.speed:g}")
    time_ = f"{moment:%Y-%m-%d %H:%M:%S}.{moment.microsecond // 100_000}"
    return f"{time_} · {doing} · {player.sent} sent · {player.skipped} skipped"
