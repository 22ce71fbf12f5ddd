"""The config section of camera and microphone."""

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pebble.config import problems
from pebble.config.reader import Reader, Rule
from pebble.config.types import EMPTY, ONE_VALUE, UNIT, File, Section, ServiceSection, doc
from pebble.extensions.media.config import AudioChannels, FramesPerSecond, Pixels, Rotation, SampleRate
from pebble.ownership import others_in
from pebble.transports.socket_paths import fits_socket

_SOCKET = "examples/gstreamer_sockets.py chooses them"
_SHMSINK = {"shm_size": _SOCKET, "wait_for_connection": _SOCKET}


class CameraCapture(Section, frozen=True, kw_only=True):
    """The camera."""

    retired: ClassVar = {**_SHMSINK, "io_mode": "OpenCV chooses by itself"}
    other_names: ClassVar = {"controls": "camera_controls"}

    enabled: Annotated[bool, doc("Open the camera.")] = True
    backend: Annotated[
        Literal["v4l2", "libcamera", "arducam", "picamera2", "synthetic"],
        doc("How the camera is reached; `synthetic` needs none."),
    ] = "v4l2"
    device: Annotated[
        str, doc("Device of a v4l2 camera, or a file or URL; of a synthetic one, `world.json#goob`: a simulated robot.")
    ] = "/dev/video0"
    capture_format: Annotated[str, doc("Of v4l2: `auto`, `raw`, `mjpeg`, or a pixel format such as `yuyv`.")] = "auto"
    camera_name: Annotated[str | None, doc("Which libcamera camera; unset: the first.")] = None
    camera_controls: Annotated[dict[str, Any], doc("Settings passed to the camera unchanged.")] = EMPTY
    width: Annotated[Pixels, doc("Pixels.")] = 640
    height: Annotated[Pixels, doc("Pixels.")] = 480
    fps: Annotated[FramesPerSecond, doc("Frames per second.")] = 15
    rotate_degrees: Annotated[Rotation, doc("Clockwise.")] = 0
    socket_path: Annotated[
        File | None, doc("Where programs of the original read raw BGR; examples/gstreamer_sockets.py offers it there.")
    ] = None


class Microphone(Section, frozen=True, kw_only=True):
    """The microphone."""

    retired: ClassVar = _SHMSINK

    enabled: Annotated[bool, doc("Open the microphone.")] = True
    source: Annotated[
        Literal["alsa", "auto", "synthetic"], doc("How the microphone is reached; `synthetic` needs none.")
    ] = "alsa"
    device: Annotated[str | None, doc("ALSA device; unset: the default.")] = None
    rate: Annotated[SampleRate, doc("Samples per second.")] = 16000
    channels: Annotated[AudioChannels, doc("1 is mono, 2 stereo.")] = 1
    socket_path: Annotated[
        File | None, doc("Where programs of the original read S16LE; examples/gstreamer_sockets.py offers it there.")
    ] = None


class AvDaemon(ServiceSection, frozen=True, kw_only=True):
    """Owns the camera and the microphone."""

    retired: ClassVar = {
        **dict.fromkeys(("restart_delay_seconds", "stop_timeout_seconds", "cwd"), ONE_VALUE),
        "env": UNIT,
    }

    video: Annotated[CameraCapture, doc("Camera.")] = CameraCapture()
    audio: Annotated[Microphone, doc("Microphone.")] = Microphone()

    def sockets(self) -> dict[str, Path]:
        """Return the GStreamer sockets for programs of the original, by the section that names them."""
        if not self.enabled:
            return {}
        sections: dict[str, CameraCapture | Microphone] = {"video": self.video, "audio": self.audio}
        return {
            name: section.socket_path
            for name, section in sections.items()
            if section.enabled and section.socket_path is not None
        }


def _check(reader: Reader, devices: AvDaemon, path: problems.Path) -> AvDaemon:
    """Check the sockets for programs of the original. A missing folder is a warning: only those programs need it."""
    sockets = devices.sockets()
    for section, file in sockets.items():
        if not file.parent.is_dir():
            text = f"there is no folder {file.parent}: until there is, no program finds this socket"
            reader.notes.warning((*path, section, "socket_path"), text)
        elif why := others_in(file.parent):
            text = f"{why}: others can offer their pictures there: name a folder of the robot's user"
            reader.notes.warning((*path, section, "socket_path"), text)
        if not fits_socket(file):
            text = f"{file} is too long for a socket, write a shorter one"
            reader.notes.problem((*path, section, "socket_path"), text)
    if len(sockets) > len(set(sockets.values())):
        reader.notes.problem((*path, "audio", "socket_path"), "is also that of video, write another")
    return devices


RULES: tuple[Rule, ...] = ((AvDaemon, _check),)
