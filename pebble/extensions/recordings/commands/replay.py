"""``pebble replay``: publishes a recording again, harmlessly unless asked for more."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pebble.config.visible import shown
from pebble.errors import PebbleError
from pebble.extensions.operator.client.url import settings_of
from pebble.extensions.operator.commands import show
from pebble.extensions.operator.commands.options import CaCert, PasswordFile
from pebble.extensions.operator.signals import handled_by
from pebble.extensions.recordings.catalogue import check_name
from pebble.extensions.recordings.commands.options import RecordingsArgument, Since, Until, period
from pebble.extensions.recordings.commands.report import report_unread
from pebble.extensions.recordings.library import files, problems
from pebble.extensions.recordings.replay.player import FASTEST, SLOWEST, BusOutput, Player
from pebble.extensions.recordings.replay.robots import Make, ReplayedRobots
from pebble.extensions.recordings.replay.rules import SYSTEM, Options, Rules
from pebble.extensions.recordings.replay.source import ReplaySource
from pebble.transports import Message, Transport, create
from pebble.transports.topics import matches

_WITH_COMMANDS = 1.0  # the lowest speed: a drive command moves a robot until the next one

UrlOption = Annotated[
    str,
    typer.Option(
        "--url", help="mqtt://[USER@]HOST[:PORT], mqtts://… or zenoh:RUN_DIR.", metavar="URL", show_default=False
    ),
]
Base = Annotated[str | None, typer.Option(help=f"First level of the new topics. [default: {SYSTEM}]", metavar="SYSTEM")]
Speed = Annotated[float, typer.Option(min=SLOWEST, max=FASTEST, help="1: as it was.")]
Loop = Annotated[bool, typer.Option("--loop", help="Begin again at the end.")]
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
    only: Only = None,
    incoming: Incoming = False,
    password_file: PasswordFile = None,
    ca_cert: CaCert = None,
) -> int:
    """Publish a recording again, at its pace.

    It appears under other topics, `replay/` for `pebble/`, without any command, and nothing of it is retained. At the
    end its robots are published as offline; if the process is killed, the broker does it. A replay stops no robot and
    resets no emergency stop, whatever the options.

    \b
        pebble replay walk.mcap --url mqtt://127.0.0.1
        pebble replay recordings --url mqtt://broker --since 10:00 --speed 4
        pebble replay walk.mcap --url mqtt://127.0.0.1 --base test --incoming
    """
    options = Options(system=base or SYSTEM, incoming=incoming, only=tuple(only or ()))
    if incoming and speed < _WITH_COMMANDS:
        raise PebbleError(f"--speed {speed:g} would drive a robot for longer than it was: leave out --incoming")
    kind, settings = settings_of(url, password_file=password_file, ca_cert=ca_cert)

    def make_transport(name: str, will: Message | None) -> Transport:
        return create(kind, name.replace("/", "-"), settings, will=will)

    since_ns, until_ns = period(since, until)
    source, rules = _read(recordings, options)
    make_player = partial(
        Player, source, rules.publishes, now=time.monotonic,
        since_ns=since_ns, until_ns=until_ns, speed=speed, loop=loop,
    )  # fmt: skip
    playing = _Playing()
    player = playing.play(make_transport, rules, make_player)
    typer.echo(f"{player.sent} sent, {player.skipped} skipped")
    unread = report_unread(problems(source.damages))
    return unread if playing.ended in ("", "SIGINT", "SIGTERM") else 1  # 1: its terminal was closed


def _read(recordings: list[Path], options: Options) -> tuple[ReplaySource, Rules]:
    """Return the recording to replay, and its rules. Raises PebbleError if it has no messages to replay."""
    source = ReplaySource(files(recordings))
    topics = {channel.topic for channel in source.channels if not channel.topic.startswith("$")}
    rules = Rules(options, source.channels)
    if not problems(source.damages):  # else it may have topics that cannot be read
        for filter_ in options.only:
            if not any(matches(filter_, topic) for topic in topics):
                check_name("topic", filter_, topics, recordings)
    if not rules.robots:
        report_unread(problems(source.damages))
        raise PebbleError("there is nothing to publish in this recording; see --only and --incoming")
    if source.missing:
        missing = show.counted(source.missing, "message")
        typer.echo(f"pebble: {missing} missing in this recording: files were damaged", err=True)
    return source, rules


class _Playing:
    """A replay until the end of the recording, or until a signal."""

    def __init__(self) -> None:
        self.ended = ""  # by which signal
        self._problem = ""

    def play(self, make: Make, rules: Rules, make_player: Callable[..., Player]) -> Player:
        """Replay for the robots of ``rules``. Raises TransportError.

        ``make`` makes a transport. ``make_player`` makes the player for an output and the function that it waits by.
        """
        robots = ReplayedRobots(make, rules.robots)
        with handled_by(self._end), robots:
            output = BusOutput(rules, robots.publish, time.time_ns)
            # The player waits only in ``run``, when ``player`` has its value.
            player: Player = make_player(output, wait=lambda seconds: self._wait(seconds, player, robots))
            typer.echo(", ".join(map(shown, rules.robots)))
            sys.stdout.flush()
            player.run()
        return player

    def _wait(self, seconds: float, player: Player, robots: ReplayedRobots) -> None:
        """Wait; print each change of the connection's state, and end the replay if a signal has come."""
        time.sleep(seconds)
        if robots.problem != self._problem:
            self._problem = robots.problem
            typer.echo(f"pebble: {shown(self._problem) or 'it goes on'}", err=True)
        if self.ended and not player.ended:
            player.stop()

    def _end(self, number: int, _frame: object) -> None:
        """End the replay. Later signals are ignored until everything is cleaned up."""
        self.ended = self.ended or signal.Signals(number).name
