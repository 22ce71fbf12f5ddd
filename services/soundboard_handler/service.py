"""The service that plays the clips of a folder when commands name them (paper A.8.10)."""

import math
import time
from typing import Any

from msgspec import Struct

from pebble.config.home import in_home
from pebble.contract import MEDIA_REPORT, SOUNDBOARD_COMMAND, SOUNDBOARD_FILES, SOUNDBOARD_STATUS
from pebble.contract.payloads import STOP_WORDS, MediaReport, SoundboardCommand, SoundboardFiles, SoundboardStatus
from pebble.errors import PebbleError
from pebble.runtime.service import Service, on
from pebble.services.soundboard_handler.clips import Clip, Clips
from pebble.services.soundboard_handler.config import SoundboardHandler as SoundboardHandlerSection
from pebble.services.soundboard_handler.playback import Playback

_PLAY = ("play", "start", "on", "enable", "enabled")
_AT_ONCE_S = 1.0  # a player that fails so soon may not have got the device
_REPORT_AGE_S = 3.0  # of a report that still counts; one comes every second
_SHORTEST_S = 0.2  # between two starts of a clip that is repeated
_SCAN_S = 10.0  # between two looks into the folder of sounds
_KILL_S = 5.0  # before a player that does not end is killed
_STOP_S = 2.0  # the same when the service ends: the launcher kills it after three
_LONGEST_NAME = 300  # characters in an error


class _Request(Struct):
    """A clip to play next, and the number of times."""

    clip: Clip
    times: float
    starts: int = 0  # how often its player was started


class SoundboardHandler(Service):
    """The player of clips, one at a time: the next one starts when the player of the last one has ended."""

    name = "soundboard_handler"

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._section = self.config.section(SoundboardHandlerSection)
        self._clips = Clips(self._section.playback.directory or in_home("~/sounds"))
        self._listed: list[str] | None = None  # the clips as published last; None: nothing was published yet
        self._scan_problem = ""  # of the folder, as logged last
        self._playback: Playback | None = None  # the player, until its end was handled
        self._started_at = 0.0  # when the newest player began to play
        self._request: _Request | None = None  # what is played now, or will be when the player has ended
        self._error: str | None = None  # in the status: why the newest command did not play
        self._talk_back_at = -math.inf  # when audio_receiver last reported that it plays

    def start(self) -> None:
        self.timers.add(self.clock(), self.scan, period=_SCAN_S)
        self._publish_status()

    def stop(self) -> None:
        playback, self._playback = self._playback, None
        if playback is not None:
            playback.stop()
            playback.wait(_STOP_S)
        self._publish_status()

    @on(SOUNDBOARD_COMMAND)
    def command(self, command: SoundboardCommand) -> None:
        """Play or stop a clip; ``action`` wins over ``enabled``."""
        action = (command.action or "").strip().lower()
        is_known = action in (*_PLAY, *STOP_WORDS)
        play = action in _PLAY if is_known else command.enabled
        if play is None:
            self.log.warning("ignored a command that neither plays nor stops: %.100r", command.action)
            return
        self._error = None
        if not play:
            self._replace(None)
        elif (request := self._requested(command)) is not None:
            self._replace(request)
        else:
            self._publish_status()

    @on(MEDIA_REPORT)
    def media_report(self, report: MediaReport, program: str) -> None:
        """Note when talk-back used the loudspeaker."""
        if program == "audio_receiver" and report.running and (report.doing or "").startswith("plays"):
            self._talk_back_at = self.clock()

    def _requested(self, command: SoundboardCommand) -> _Request | None:
        """Return the clip to play; None, with an error in the status, if there is none."""
        name = command.file or ""
        if not name.strip():
            self._error = "Play command missing file"
            return None
        not_found = f"Sound file not found: {name[:_LONGEST_NAME]}"
        try:
            clip = self._clips.find(name)
            if clip is None and name != name.strip():
                clip = self._clips.find(name.strip())
        except PebbleError as error:
            self._error = f"{not_found}: {error}"
            return None
        if clip is None:
            self._error = not_found
            return None
        repeat = command.repeat  # True: until it is stopped, a number: so often, else once
        return _Request(clip, math.inf if repeat is True else max(1, repeat or 1))

    def scan(self) -> None:
        """List the clips; publish the list, and log what cannot be read, when that has changed."""
        files = self._clips.scan()
        if self._clips.problem != self._scan_problem:
            self._scan_problem = self._clips.problem
            if self._scan_problem:
                self.log.warning("clips: %s", self._scan_problem)
        if files != self._listed:
            self._listed = files
            self.publish(SOUNDBOARD_FILES, SoundboardFiles(files=files, timestamp=time.time()))

    def _replace(self, request: _Request | None) -> None:
        """Stop the player, and play ``request`` when it has ended."""
        self._request = request
        playback = self._playback
        if playback is not None and not playback.stopped:
            playback.stop()
            self.call_at(self.clock() + _KILL_S, playback.kill)
        if playback is None or playback.ended:
            self._play_next()

    def _play_next(self) -> None:
        """Play the waiting request, if there is one."""
        self._playback = None
        if self._request is not None:
            self._request.starts += 1  # until it was played ``times`` times, see _changed
            self._playback = Playback(self._request.clip, self.config, self.post_first, self._changed)
            self._playback.start()
        else:
            self._publish_status()

    def _changed(self, playback: Playback) -> None:
        """React to a player that has started or ended."""
        if playback is not self._playback:
            return
        request = self._request
        if not playback.ended:
            self._started_at = self.clock()
            if request is not None and request.starts == 1:  # the status of a repeated clip is the same
                self._publish_status()
        elif playback.stopped:
            self._play_next()
        elif not playback.problem and request is not None and request.starts < request.times:
            self.call_at(self._started_at + _SHORTEST_S, lambda: self._repeat(playback))
        else:
            self._request, self._error = None, self._problem_of(playback)
            self._play_next()

    def _repeat(self, playback: Playback) -> None:
        if playback is self._playback and not playback.stopped:
            self._play_next()

    def _problem_of(self, playback: Playback) -> str | None:
        now = self.clock()
        at_once, talk_back = now - self._started_at < _AT_ONCE_S, now - self._talk_back_at < _REPORT_AGE_S
        if playback.exit_code != 0 and at_once and talk_back:
            return "the loudspeaker is busy (talk-back plays)"
        return playback.problem or None

    def _publish_status(self) -> None:
        playback = self._playback
        playing = playback is not None and playback.process is not None
        file = playback.clip.name if playback is not None and playing else None
        status = SoundboardStatus(playing=playing, timestamp=time.time(), file=file, error=self._error)
        self.publish(SOUNDBOARD_STATUS, status)
