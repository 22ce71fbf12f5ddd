"""The playback of one clip: a player's process in its own group, which ends with this service."""

from __future__ import annotations

import signal
import subprocess
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import IO, TYPE_CHECKING

from pebble.config import Config
from pebble.errors import PebbleError
from pebble.extensions.media.child import Child
from pebble.extensions.media.config import Media
from pebble.runtime.environment import child_environment
from pebble.services.soundboard_handler.clips import Clip
from pebble.services.soundboard_handler.config import SoundboardHandler

if TYPE_CHECKING:
    from pebble.extensions.media.sound_file import SoundFile

Post = Callable[[Callable[[], None]], None]


class Playback:
    """A playback of ``clip``. All methods are for the service's thread; ``on_change`` is posted there by ``post``.

    ``on_change`` is called when the player runs (``process`` is set), and when the playback has ended.
    """

    def __init__(self, clip: Clip, config: Config, post: Post, on_change: Callable[[Playback], None]) -> None:
        self.clip = clip
        self.process: Child | None = None
        self.ended = self.stopped = False
        self.problem = self._decoding_problem = ""  # for operators; why the file could not be decoded to its end
        self.exit_code = 0
        self._config, self._post = config, post
        self._on_change = partial(on_change, self)

    def start(self) -> None:
        """Start the playback on the service's thread, because a player ends with the thread that has started it."""
        try:
            if self.clip.encoded:
                self._start_decoded()
            else:
                self._start_player(self._words, subprocess.DEVNULL)
        except (PebbleError, OSError, ValueError) as error:
            self.problem, self.ended = f"Failed to start playback: {error}", True
        self._post(self._on_change)

    def stop(self) -> None:
        """End the playback soon. A stopped player's exit code is no error."""
        self.stopped = True
        if self.process is not None:
            self.process.signal(signal.SIGTERM)

    def kill(self) -> None:
        if self.process is not None:
            self.process.signal(signal.SIGKILL)

    def wait(self, timeout: float) -> None:
        """Wait until the player has ended; kill it after ``timeout`` seconds."""
        if self.process is not None:
            self.process.finish(timeout)

    @property
    def _words(self) -> list[str]:
        """Command line that plays a wav file. Its path replaces ``{file}``, or is added at the end."""
        command, path = list(self._config.section(SoundboardHandler).playback.player_command), str(self.clip.path)
        words = [word.replace("{file}", path) for word in command]
        return words if words != command else [*words, path]

    def _start_decoded(self) -> None:
        """Decode on another thread, only as fast as the player reads."""
        from pebble.extensions.media.sound_file import SoundFile  # only where a clip is decoded: it costs memory

        file = SoundFile(self.clip.path)
        try:
            command = self._config.section(Media).audio_receiver.words(file.rate, file.channels)
            player = self._start_player(command, subprocess.PIPE)
        except (OSError, ValueError):
            file.close()
            raise
        threading.Thread(target=self._feed, args=(file, player.pipe("stdin")), name="pebble-feed", daemon=True).start()

    def _start_player(self, command: list[str], stdin: int) -> Child:
        self.process = player = Child(command, child_environment(), stdin=stdin)
        player.watch(lambda code: self._post(partial(self._finished, code)))
        return player

    def _feed(self, file: SoundFile, pipe: IO[bytes]) -> None:
        with suppress(OSError), file, pipe:  # OSError: the player has ended before the clip
            try:
                for chunk in file.chunks():
                    pipe.write(chunk)
            except PebbleError as error:
                self._decoding_problem = str(error)

    def _finished(self, code: int) -> None:
        self.exit_code, self.ended = code, True
        if not self.stopped:
            self.problem = f"player exited with code {code}" if code else self._decoding_problem
        self._on_change()
