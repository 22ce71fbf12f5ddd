"""The process that plays one robot's recording for one page: it obeys the page, and sends the recording's messages.

Both ways each message has a head: its size, and whether it is text or binary. The program:
``python -m pebble.extensions.page.recordings.playing SOCKET FOLDER ROBOT AT_MS``.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import msgspec

from pebble import contract as c
from pebble.contract.channels import LOGS
from pebble.errors import PebbleError
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.page import messages as m
from pebble.extensions.page.log_lines import line_of
from pebble.extensions.page.robots import liveness_of
from pebble.extensions.page.shown import shown
from pebble.extensions.recordings.files.recorded import Recorded
from pebble.extensions.recordings.replay.player import Player
from pebble.extensions.recordings.replay.rules import SYSTEM, harmless
from pebble.extensions.recordings.seek.archive import Archive, metric_of
from pebble.extensions.recordings.stamps import is_media, is_picture
from pebble.runtime.parent import end_with_parent
from pebble.transports import Message

HEAD: Final = struct.Struct(">IB")
TEXT, BINARY = 0, 1
MEDIUM: Final = struct.Struct(">Bd")  # what a binary message is, and when it was received, in epoch milliseconds
FOR_DECODER, PICTURE, SOUND = range(3)  # the first is not shown: later pictures build on it
_NICE: Final = 10  # driving comes first
_STEP_NS: Final = 10**9  # of a recording, that is read at once
_GAP_NS: Final = 2 * 10**9  # a longer time without messages is left out
_FLUSH_S: Final = 0.05
_PLAYED_S: Final = 0.25  # between two messages about where it is
_LIVENESS_S: Final = 0.5
_PICTURE_S: Final = 1 / 40  # of a recording that is played fast not every picture is shown

_LIVENESS: Final = {channel.metric: channel for channel in (c.ONLINE, c.LINK)}

_ops = msgspec.json.Decoder(m.FromReplay)


def main(number: str, folder: str, ref: str, at_ms: str) -> None:
    """Play for the page at the other end of socket number SOCKET, until the page closes it."""
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in a terminal reaches the whole group: the parent ends this
    os.nice(_NICE)
    page = Link(socket.socket(fileno=int(number)))
    try:
        PlayedRobot(page, Archive(Path(folder)), ref, _ns(float(at_ms))).player.run()
    except PebbleError as error:
        page.write(m.Bye(why=str(error), again=False))
    except (EOFError, ConnectionError):
        return


class Link:
    """The socket to the server. A page that reads slowly slows the player."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._received = bytearray()

    def write(self, message: m.ToReplay) -> None:
        self._write(TEXT, msgspec.json.encode(message))

    def write_medium(self, what: int, at_ms: float, payload: bytes) -> None:
        self._write(BINARY, MEDIUM.pack(what, at_ms) + payload)

    def read(self, seconds: float) -> list[m.FromReplay]:
        """Return the page's messages that arrive within ``seconds``. Raises EOFError once the page is gone."""
        readable, _, _ = select.select([self._connection], [], [], seconds)
        if not readable:
            return []
        data = self._connection.recv(1 << 16)
        if not data:
            raise EOFError
        self._received += data
        ops: list[m.FromReplay] = []
        while len(self._received) >= HEAD.size:
            end = HEAD.size + HEAD.unpack_from(self._received)[0]
            if len(self._received) < end:
                break
            ops.append(_ops.decode(self._received[HEAD.size : end]))
            del self._received[:end]
        return ops

    def _write(self, what: int, data: bytes) -> None:
        self._connection.sendall(HEAD.pack(len(data), what) + data)


class RobotSource:
    """The messages of one robot in an archive, for a player.

    Before the state at a time is sent, ``begins`` is called with that time and the camera's newest picture at it. A
    message received exactly at a time belongs to the state at that time.
    """

    def __init__(self, archive: Archive, ref: str, begins: Callable[[int, Recorded | None], None]) -> None:
        self._archive, self._ref, self._begins = archive, ref, begins

    def messages(self, since_ns: int, until_ns: int) -> Iterator[Recorded]:
        """Yield the messages after ``since_ns``, read in steps of a second: some after ``until_ns`` may come, too."""
        next_ns: int | None = since_ns + 1
        while next_ns is not None and next_ns < until_ns:
            messages = self._archive.messages(self._ref, next_ns, next_ns + _STEP_NS)
            yield from messages
            next_ns += _STEP_NS
            if not messages:
                next_ns = self._archive.next_ns(self._ref, next_ns)

    def state_before(self, at_ns: int, _publishes: object) -> list[Recorded]:
        """Return each topic's newest value, the last log lines, and the pictures since a key frame."""
        archive, log_topic = self._archive, LOGS.topic(self._ref)
        state = [message for message in archive.state(self._ref, at_ns + 1) if message.channel.topic != log_topic]
        pictures = archive.pictures(self._ref, at_ns + 1)
        self._begins(at_ns, pictures[-1] if pictures else None)
        return [*state, *archive.log_lines(self._ref, at_ns + 1), *pictures]


class PlayedRobot:
    """The output of the player of one robot's recording: it sends messages in the form that pages read."""

    def __init__(self, link: Link, archive: Archive, ref: str, at_ns: int) -> None:
        self.sent = self.skipped = 0  # an output has them; nothing is counted here
        self.moves = False  # a shown recording moves nothing
        self._newest_ns = at_ns  # of what was sent
        # _begin sets what starts again with each seek, such as _picture, the newest at that time, and _pictured_at, the
        # time of the last one that was shown. The source calls it, the first time before any message.
        self.player = Player(
            RobotSource(archive, ref, self._begin),
            lambda _channel: True,  # play all channels
            self,
            now=time.monotonic,
            wait=self._wait,
            since_ns=max(1, at_ns),  # at 0 the player would not ask the source for a state
            paused=True,
            stays=True,  # pauses at the end: the page may seek
            longest_gap_ns=_GAP_NS,
        )
        self._link, self._ref = link, ref
        self._replayed = f"{SYSTEM}/{ref.partition('/')[2]}"  # the base of the topics that pages see

    def send(self, message: Recorded, _position_ns: int) -> bool:
        """Send a recorded message, or keep it for the next flush; return True, as it is never refused."""
        at_ns, newest_ns = message.log_ns, self._newest_ns
        if at_ns - newest_ns > _GAP_NS:
            self._show(skipped=(newest_ns / 1e6, at_ns / 1e6))
        self._newest_ns = max(newest_ns, at_ns)
        metric, incoming = metric_of(message.channel.topic)
        if incoming:  # pages show what the robot has published
            return True
        if is_media(message.payload):
            self._take_medium(message)
        elif metric == LOGS.metric:
            line = line_of(message.payload)
            if line is not None:
                self._lines.append(line)
        elif not message.payload:
            self._values[metric] = None, at_ns / 1e6
        else:
            self._take_value(metric, message)
        return True

    def halt(self) -> None:
        """Do nothing, as a shown recording moves nothing."""

    # -- what the page asks for

    def _wait(self, seconds: float) -> None:
        """Send what is due, then wait for the page's requests, and handle them. The player calls this."""
        self._flush(time.monotonic())
        ops = self._link.read(seconds)
        seeks = [op for op in ops if isinstance(op, m.Seek)]
        if seeks:  # the page wants only the last of several
            self.player.seek(_ns(seeks[-1].at))
        for op in ops:
            if isinstance(op, m.Play):
                self.player.resume() if op.on else self.player.pause()
            elif isinstance(op, m.Speed):
                self.player.speed = op.speed
        if ops:
            self._show()

    # -- what the page is sent

    def _begin(self, at_ns: int, picture: Recorded | None) -> None:
        """Start again at another time after a seek."""
        self._picture, self._newest_ns = picture, at_ns
        self._values: dict[str, tuple[Any, float]] = {}  # to be sent, by metric: the value, and when it came in ms
        self._lines: list[msgspec.Raw] = []  # to be sent
        self._next_line = 1  # the number of the first of them
        self._is_new = True  # nothing was sent since the seek
        self._rested = False  # the page was told that the player rests
        self._robot = RobotView(self._ref)
        self._flushed_at = self._played_at = self._liveness_at = self._pictured_at = float("-inf")  # sent last
        player = self.player
        self._link.write(m.Played(at=at_ns / 1e6, on=not player.paused, speed=player.speed, begins=True))

    def _show(self, skipped: tuple[float, float] | None = None) -> None:
        """Send the position and the player's state."""
        player, self._played_at = self.player, time.monotonic()
        at_ms = player.position_ns / 1e6
        self._link.write(
            m.Played(at=at_ms, on=not player.paused, speed=player.speed, ended=player.at_end, skipped=skipped)
        )

    def _flush(self, now: float) -> None:
        """Send changed values and log lines, and a few times a second the position."""
        if now - self._flushed_at < _FLUSH_S or self.player.restores:  # the state after a seek goes into one message
            return
        self._flushed_at = now
        position_ms = self.player.position_ns / 1e6
        rests = self.player.paused and not self._is_new  # _is_new: after a seek even a paused player has to show it
        is_position_due = not rests and now - self._played_at >= _PLAYED_S
        knows_state = rests == self._rested  # the page was told whether the player rests now
        if is_position_due or not knows_state:
            self._rested = rests
            self._show()
        if not rests and now - self._liveness_at >= _LIVENESS_S and self._robot.live:
            self._liveness_at = now
            self._values["web/liveness"] = liveness_of(self._robot, position_ms / 1e3), position_ms
        if self._values or self._is_new:
            self._is_new = False
            # The last member of each is the age of the value.
            values = ((self._ref, metric, raw, position_ms - at_ms) for metric, (raw, at_ms) in self._values.items())
            self._link.write(m.State(now=position_ms, set=tuple(values)))
            self._values = {}
        if self._lines:
            lines = tuple(self._lines)
            self._link.write(m.Logs(ref=self._ref, origin="recording", first=self._next_line, lines=lines))
            self._next_line += len(lines)
            self._lines = []

    def _take_value(self, metric: str, message: Recorded) -> None:
        """Keep a value for the next flush, in the form for pages."""
        payload, received = message.payload, message.log_ns / 1e9
        if metric == c.CAPABILITIES.metric:
            payload = harmless(payload, self._ref, self._replayed)
        elif (channel := _LIVENESS.get(metric)) is not None:
            retained = message.channel.metadata.get("retained") == "1"
            # A recording has one clock: it stands for the monotonic one and for the time of day.
            self._robot.receive(channel, Message(message.channel.topic, payload, retain=retained), received, received)
        try:
            payload = shown(c.channel_of(f"{c.OUTGOING}/{metric}"), payload, msgspec.json.decode(payload))
        except (ValueError, RecursionError):  # msgspec's are ValueErrors
            return
        self._values[metric] = msgspec.Raw(payload), received * 1e3

    def _take_medium(self, message: Recorded) -> None:
        """Send sound if it is played at normal speed, and each picture: to be shown, or only decoded for later ones."""
        payload, at_ms, now = message.payload, message.log_ns / 1e6, time.monotonic()
        if not is_picture(payload):
            if self.player.speed == 1 and not self.player.paused:
                self._link.write_medium(SOUND, at_ms, payload)
            return
        if self._picture is not None and message.log_ns <= self._picture.log_ns:
            is_shown = message is self._picture  # after a seek only the picture at that time is shown
        else:
            is_shown = now - self._pictured_at >= _PICTURE_S
        if is_shown:
            self._pictured_at = now
        self._link.write_medium(PICTURE if is_shown else FOR_DECODER, at_ms, payload)


def _ns(ms: float) -> int:
    """Return nanoseconds, exact to a microsecond."""
    return round(ms * 1000) * 1000


if __name__ == "__main__":
    main(*sys.argv[1:])
