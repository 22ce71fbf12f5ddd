"""One clip in one player: a process in a group of its own, which ends with this service."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import IO, Any

from msgspec import Struct

from pebble.config import Config
from pebble.media.player import filled
from pebble.runtime.environment import child_environment
from pebble.runtime.parent import tied_to_parent
from pebble.services.soundboard_handler.clips import Clip
from pebble.services.soundboard_handler.feed import Feed

Post = Callable[[Callable[[], None]], None]


class Players(Struct, frozen=True):
    """The programs that play: ``wav`` gets a file, ``raw`` samples on its standard input."""

    wav: Sequence[str]
    raw: Sequence[str]
    device: str
    volume: float

    @classmethod
    def of(cls, config: Config) -> Players:
        playback, raw = config.services.soundboard_handler.playback, config.services.mqtt_bridge.media.audio_receiver
        return cls(playback.player_command, raw.command, raw.device, playback.volume)

    def command(self, path: Path) -> list[str]:
        """``{file}`` stands for the path; without one it is the last word."""
        words = [word.replace("{file}", str(path)) for word in self.wav]
        return words if words != list(self.wav) else [*words, str(path)]

    def started(self, words: list[str], stdin: int | IO[bytes], **options: Any) -> subprocess.Popen[bytes]:
        """Start a player in a process group of its own; it ends with the calling thread. Raises OSError, ValueError."""
        return subprocess.Popen(
            tied_to_parent(words),
            stdin=stdin,
            env=child_environment(),
            start_new_session=True,  # what the player starts is stopped with it
            **options,
        )

    def raw_command(self, rate: int, channels: int) -> list[str]:
        return filled(self.raw, rate=rate, channels=channels, device=self.device)


class Playback:
    """Plays ``clip`` once. All methods are for the service's thread; ``on_change`` is posted there by ``post``.

    It is called when the player runs (``process`` is set), and when the playback has ended.
    """

    def __init__(self, clip: Clip, players: Players, post: Post, on_change: Callable[[Playback], None]) -> None:
        self.clip = clip
        self.process: subprocess.Popen[bytes] | None = None
        self.ended = self.stopped = False
        self.problem = ""
        self.exit_code = 0
        self._players, self._post = players, post
        self._on_change = partial(on_change, self)
        self._feed: Feed | None = None

    def start(self) -> None:
        if self.clip.encoded or self._players.volume != 1.0:
            self._feed = Feed(self.clip.path, self._players.volume, lambda: self._post(self._opened))
        else:
            self._start_player(self._players.command(self.clip.path))

    def stop(self) -> None:
        """End soon: at once if there is no player yet. How a stopped player exits is no error."""
        self.stopped = True
        if self.process is not None:
            self._signal(signal.SIGTERM)
        elif not self.ended:
            self.ended = True
            if self._feed is not None:
                self._feed.cancel()

    def kill(self) -> None:
        self._signal(signal.SIGKILL)

    def wait(self, timeout: float) -> None:
        """Until the player has ended, or killed after ``timeout`` seconds."""
        if self.process is not None:
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(timeout)
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()

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
        elif self.process.stdin is not None:
            self._feed.write_to(self.process.stdin)

    def _start_player(self, words: list[str]) -> None:
        """On this thread, because the player ends with the thread that has started it."""
        try:
            self.process = self._players.started(words, subprocess.DEVNULL if self._feed is None else subprocess.PIPE)
        except (OSError, ValueError) as error:
            self._fail(str(error))
            return
        threading.Thread(target=self._wait, args=(self.process.pid,), name="pebble-player", daemon=True).start()
        self._post(self._on_change)

    def _wait(self, pid: int) -> None:
        """On a thread of its own. The process remains a zombie, so that ``_reap`` cannot kill another of its number."""
        with suppress(ChildProcessError):  # the service ends, and has waited itself
            os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
        self._post(self._reap)

    def _reap(self) -> None:
        if self.process is None:
            return
        self._signal(signal.SIGKILL)  # what it has left behind
        self.exit_code = self.process.wait()
        if not self.stopped and self.exit_code != 0:
            self.problem = f"player exited with code {self.exit_code}"
        elif not self.stopped and self._feed is not None:
            self.problem = self._feed.problem
        self.ended = True
        self._on_change()

    def _fail(self, why: str) -> None:
        self.problem, self.ended = f"Failed to start playback: {why}", True
        self._post(self._on_change)

    def _signal(self, number: int) -> None:
        if self.process is not None and not self.ended:
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, number)
