"""Runs a foreign streaming program while video is requested: ``python -m pebble.services.video_stream CONFIG``."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from typing import Any

from pebble.errors import ConfigError, DeviceError
from pebble.runtime.environment import child_environment
from pebble.runtime.parent import tied_to_parent
from pebble.runtime.process import run
from pebble.runtime.service import Service, every

_STOP_S = 2.0  # between SIGTERM and SIGKILL; the launcher kills a service after three


class VideoStream(Service):
    """The launcher runs this service while video is requested. What the program writes goes to the robot's log."""

    name = "video_stream"

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._program: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        options = self.config.services.video_stream
        if not options.command:
            raise ConfigError("services.video_stream.command: is missing, write the program that streams the video")
        try:
            self._program = subprocess.Popen(
                tied_to_parent(options.command),
                env=child_environment(),
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # what it starts ends with it
            )
        except (OSError, subprocess.SubprocessError) as error:
            raise DeviceError(f"cannot start {options.command[0]}: {error}") from error

    def stop(self) -> None:
        program = self._program
        if program is None:
            return
        _signal(program, signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            program.wait(_STOP_S)
        _signal(program, signal.SIGKILL)  # its children, too
        program.wait()

    @every(1.0)
    def poll(self) -> None:
        """Fail when the program has ended: the launcher restarts this process, with longer and longer delays."""
        code = None if self._program is None else self._program.poll()
        if code is not None:
            how = f"exit code {code}" if code >= 0 else f"signal {-code}"
            raise DeviceError(f"{self.config.services.video_stream.command[0]} ended: {how}")


def _signal(program: subprocess.Popen[bytes], number: int) -> None:
    with suppress(ProcessLookupError):
        os.killpg(program.pid, number)


if __name__ == "__main__":
    sys.exit(run(VideoStream))
