"""Decodes a clip on a thread of its own, and writes it to a player's standard input."""

import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from typing import IO

from pebble.errors import PebbleError

log = logging.getLogger(__name__)


class Feed:
    """Calls ``opened`` on its thread once ``rate`` and ``channels`` are known, or ``problem``; then waits for a player.

    No more is decoded than the pipe to the player holds.
    """

    def __init__(self, path: Path, opened: Callable[[], None]) -> None:
        self.rate = self.channels = 0
        self.problem = ""  # why it ended early; empty if everything was written, or the player took no more
        self._path, self._opened = path, opened
        self._pipes: SimpleQueue[IO[bytes] | None] = SimpleQueue()
        threading.Thread(target=self._run, name="pebble-feed", daemon=True).start()

    def write_to(self, pipe: IO[bytes]) -> None:
        self._pipes.put(pipe)

    def cancel(self) -> None:
        """There will be no player."""
        self._pipes.put(None)

    def _run(self) -> None:
        opened = False
        pipe: IO[bytes] | None = None
        try:
            from pebble.media.sound_file import SoundFile  # only where a clip is decoded: it costs memory

            with SoundFile(self._path) as file:
                self.rate, self.channels, opened = file.rate, file.channels, True
                self._opened()
                pipe = self._pipes.get()
                if pipe is not None:
                    for chunk in file.chunks():
                        pipe.write(chunk)
        except BrokenPipeError:
            log.debug("the player has ended before the clip")
        except (PebbleError, OSError) as error:
            self.problem = str(error)
        except Exception as error:  # of a codec: it must not leave a player that waits for more
            log.exception("%s cannot be decoded", self._path)
            self.problem = f"{type(error).__name__}: {error}"
        if pipe is not None:
            with suppress(OSError):  # what is left is written now
                pipe.close()
        if not opened:
            self._opened()
