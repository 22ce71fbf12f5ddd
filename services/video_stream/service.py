"""Runs the configured streaming program for as long as this process lives, and ends with it."""

from __future__ import annotations

import os
import signal
import subprocess
from contextlib import suppress

from pebble.errors import ConfigError, LinkError
from pebble.launched import tied
from pebble.service import Service, every

_STOP_S = 2.0  # for it to end politely; a service has to be gone after three


class VideoStream(Service):
    """The launcher runs this service while video is wanted. What the program writes goes to the robot's log."""

    name = "video_stream"

    def start(self) -> None:
        options = self.config.services.video_stream
        if not options.command:
            raise ConfigError("services.video_stream.command: is missing, write the program that streams the video")
        try:
            self._program = subprocess.Popen(
                tied(options.command),
                cwd=options.cwd,
                env={**os.environ, **options.env},
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # what it starts ends with it
            )
        except (OSError, subprocess.SubprocessError) as error:
            raise LinkError(f"cannot start {options.command[0]}: {error}") from error

    def stop(self) -> None:
        if not hasattr(self, "_program"):
            return
        self._signal(signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            self._program.wait(_STOP_S)
        self._signal(signal.SIGKILL)  # also what it started and left behind
        self._program.wait()

    @every(1.0)
    def watch(self) -> None:
        """A program that ended is a failure of ours: the launcher starts us again, ever more slowly."""
        code = self._program.poll()
        if code is not None:
            how = f"exit code {code}" if code >= 0 else f"signal {-code}"
            raise LinkError(f"{self.config.services.video_stream.command[0]} ended: {how}")

    def _signal(self, number: int) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self._program.pid, number)
