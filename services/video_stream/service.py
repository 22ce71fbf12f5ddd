"""The service that runs a third party's streaming program while video is requested."""

import signal
from typing import Any

from pebble.errors import DeviceError
from pebble.extensions.media.child import Child, how_ended
from pebble.runtime.environment import child_environment
from pebble.runtime.service import Service, every
from pebble.services.video_stream.config import VideoStream as VideoStreamSection

_STOP_S = 2.0  # between SIGTERM and SIGKILL; the launcher kills a service after three


class VideoStream(Service):
    """The service that runs while video is requested. The streaming program's output goes to the robot's log."""

    name = "video_stream"

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._program: Child | None = None

    def start(self) -> None:
        options = self.config.section(VideoStreamSection)
        try:
            self._program = Child(options.command, child_environment())
        except (OSError, ValueError) as error:
            raise DeviceError(f"cannot start {options.command[0]}: {error}") from error

    def stop(self) -> None:
        if self._program is not None:
            self._program.signal(signal.SIGTERM)
            self._program.finish(_STOP_S)

    @every(1.0)
    def poll(self) -> None:
        """Fail when the program has ended: the launcher restarts this process, after longer and longer delays."""
        code = None if self._program is None else self._program.wait(0.0)
        if code is not None:
            raise DeviceError(f"{self.config.section(VideoStreamSection).command[0]} ended: {how_ended(code)}")
