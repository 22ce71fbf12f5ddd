"""One clip in one player: a process in a group of its own, which ends with this service."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from msgspec import Struct

from pebble.config import Config
from pebble.media.player import filled
from pebble.runtime.child import Child
from pebble.runtime.environment import child_environment
from pebble.services.soundboard_handler.clips import Clip
from pebble.services.soundboard_handler.feed import Feed

Post = Callable[[Callable[[], None]], None]


class Players(Struct, frozen=True):
    """The programs that play: ``wav`` gets a file, ``raw`` samples on its standard input."""

    wav: Sequence[str]
    raw: Sequence[str]
    device: str

    @classmethod
    def of(cls, config: Config) -> Players:
        playback, raw = config.services.soundboard_handler.playback, config.services.mqtt_bridge.media.audio_receiver
        return cls(playback.player_command, raw.command, raw.device)

    def command(self, path: Path) -> list[str]:
        """``{file}`` stands for the path; without one it is the last word."""
        words = [word.replace("{file}", str(path)) for word in self.wav]
        return words if words != list(self.wav) else [*words, str(path)]

    def started(self, words: list[str], stdin: int) -> Child:
        """Start a player; it ends with the calling thread. Raises OSError, ValueError."""
        return Child(words, child_environment(), stdin=stdin)

    def raw_command(self, rate: int, channels: int) -> list[str]:
        return filled(self.raw, rate=rate, channels=channels, device=self.device)


class Playback:
    """Plays ``clip`` once. All methods are for the service's thread; ``on_change`` is posted there by ``post``.

    It is called when the player runs (``process`` is set), and when the playback has ended.
    """

    def __init__(self, clip: Clip, players: Players, post: Post, on_change: Callable[[Playback], None]) -> None:
        self.clip = clip
        self.process: Child | None = None
        self.ended = self.stopped = False
        self.problem = ""
        self.exit_code = 0
        self._players, self._post = players, post
        self._on_change = partial(on_change, self)
        self._feed: Feed | None = None

    def start(self) -> None:
        if self.clip.encoded:
            self._feed = Feed(self.clip.path, lambda: self._post(self._opened))
        else:
            self._start_player(self._players.command(self.clip.path))

    def stop(self) -> None:
        """End soon: at once if there is no player yet. How a stopped player exits is no error."""
        self.stopped = True
        if self.process is not None:
            self.process.signal(signal.SIGTERM)
        elif not self.ended:
            self.ended = True
            if self._feed is not None:
                self._feed.cancel()

    def kill(self) -> None:
        if self.process is not None:
            self.process.signal(signal.SIGKILL)

    def wait(self, timeout: float) -> None:
        """Until the player has ended, or killed after ``timeout`` seconds."""
        if self.process is not None:
            self.process.finish(timeout)

    def _opened(self) -> None:
        """The clip's format is known, or that it has none."""
        if self.ended or self._feed is None:
            return
        if self._feed.problem:
            self._fail(self._feed.problem)
            return
        self._start_player(self._players.raw_command(self._feed.rate, self._feed.channels))
        if self.process is None:
            self._feed.cancel()
        else:
            self._feed.write_to(self.process.pipe("stdin"))

    def _start_player(self, words: list[str]) -> None:
        """On this thread, because the player ends with the thread that has started it."""
        try:
            self.process = self._players.started(words, subprocess.DEVNULL if self._feed is None else subprocess.PIPE)
        except (OSError, ValueError) as error:
            self._fail(str(error))
            return
        self.process.watch(lambda code: self._post(partial(self._finished, code)))
        self._post(self._on_change)

    def _finished(self, code: int) -> None:
        self.exit_code = code
        if not self.stopped and self.exit_code != 0:
            self.problem = f"player exited with code {self.exit_code}"
        elif not self.stopped and self._feed is not None:
            self.problem = self._feed.problem
        self.ended = True
        self._on_change()

    def _fail(self, why: str) -> None:
        self.problem, self.ended = f"Failed to start playback: {why}", True
        self._post(self._on_change)
