"""The config sections of camera, microphone and video, on the robot and towards operators."""

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta, field

from pebble.config.types import (
    BY_CONTRACT,
    COMMAND,
    ONE_VALUE,
    UNIT,
    AudioChannels,
    Command,
    Count,
    File,
    FramesPerSecond,
    HandlerTopics,
    Pixels,
    Rotation,
    SampleRate,
    Section,
    ServiceSection,
    Topic,
    doc,
)
from pebble.contract.encodings import SoundEncoding, VideoEncoding

_FRAMES = "pictures and sound use the robot's own shared memory, found by transport.run_dir"
_SOURCE = "every frame has its own size and format"
_SOCKET = "examples/gstreamer_sockets.py chooses them"
_SHMSINK = {"shm_size": _SOCKET, "wait_for_connection": _SOCKET}
_INPUT = {"input_shm": _FRAMES, "input_retry_seconds": _FRAMES}


class CameraCapture(Section, frozen=True, kw_only=True):
    """The camera."""

    retired: ClassVar = {**_SHMSINK, "io_mode": "OpenCV chooses by itself"}

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
    camera_controls: Annotated[dict[str, Any], doc("Settings passed to the camera unchanged.")] = field(
        default_factory=dict
    )
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


class VideoStream(ServiceSection, frozen=True, kw_only=True):
    """Runs a third party's streaming program while operators request video."""

    retired: ClassVar = dict.fromkeys(("cwd", "env"), COMMAND)

    command: Annotated[Command, doc("The program and its arguments, without a shell; required where enabled.")] = ()
    webrtc_url: Annotated[str | None, doc("Where its pictures are shown; operator pages find it in the status.")] = None


class VideoPublisher(Section, frozen=True, kw_only=True):
    """Pictures for operators."""

    retired: ClassVar = {
        **_INPUT,
        "source_*": _SOURCE,
        "reconnect_seconds": ONE_VALUE,
        "profile": "nothing reads it",
        "bitrate": "h264 has the quality of jpeg_quality, and less on a slow connection",
    }

    encoding: Annotated[VideoEncoding, doc("How pictures are sent unless a request names another encoding.")] = "json"
    topic: Annotated[Topic | None, doc("Instead of `{base}/outgoing/front-camera`.")] = None
    overlays_topic: Annotated[Topic | None, doc("Instead of `{base}/outgoing/video-overlays`.")] = None
    width: Annotated[Pixels | None, doc("Pixels, where publish_width is not set; unset: as captured.")] = None
    height: Annotated[Pixels | None, doc("Pixels, where publish_height is not set; unset: as captured.")] = None
    fps: Annotated[FramesPerSecond | None, doc("Where neither publish_fps nor target_fps is set.")] = None
    publish_width: Annotated[Pixels | None, doc("Pixels of what is sent.")] = None
    publish_height: Annotated[Pixels | None, doc("Pixels of what is sent.")] = None
    publish_fps: Annotated[FramesPerSecond | None, doc("Frames per second of what is sent.")] = None
    target_fps: Annotated[FramesPerSecond | None, doc("Where publish_fps is not set.")] = None
    keyframe_interval: Annotated[Count | None, doc("Frames from one full picture to the next; unset: fps / 3.")] = None
    jpeg_quality: Annotated[int, Meta(ge=1, le=100, description="1 is worst and smallest.")] = 10
    rotate_degrees: Annotated[Rotation, doc("Clockwise, in addition to the camera's section.")] = 0


class AudioPublisher(Section, frozen=True, kw_only=True):
    """Sound for operators."""

    retired: ClassVar = {**_INPUT, "qos": BY_CONTRACT["qos"]}

    encoding: Annotated[SoundEncoding, doc("How sound is sent unless a request names another encoding.")] = "pcm"
    topic: Annotated[Topic | None, doc("Instead of `{base}/outgoing/audio`.")] = None
    rate: Annotated[SampleRate | None, doc("Samples per second; unset: as captured.")] = None
    channels: Annotated[AudioChannels | None, doc("1 is mono, 2 stereo; unset: as captured.")] = None
    chunk_ms: Annotated[
        int,
        Meta(ge=1, le=1000, description="Milliseconds of sound in one packet; of opus 20, 40 or 60, and each part."),
    ] = 20
    bitrate: Annotated[int, Meta(ge=6_000, le=256_000, description="Of opus, bits per second.")] = 24_000
    bundle: Annotated[int, Meta(ge=1, le=3, description="How many parts a packet of opus has.")] = 2


class AudioReceiver(Section, frozen=True, kw_only=True):
    """Sound from operators."""

    retired: ClassVar = {
        "qos": BY_CONTRACT["qos"],
        **dict.fromkeys(("queue_limit", "concealment_ms"), ONE_VALUE),
        **dict.fromkeys(("rate", "channels"), "each packet has its own"),
    }

    topic: Annotated[Topic | None, doc("Instead of `{base}/incoming/audio-stream`.")] = None
    device: Annotated[str, doc("ALSA device to play on.")] = "default"
    command: Annotated[
        Command, doc("Plays sound from its standard input; `{rate}`, `{channels}` and `{device}` are filled in.")
    ] = ("aplay", "-q", "-t", "raw", "-f", "S16_LE", "-c", "{channels}", "-r", "{rate}", "-D", "{device}", "-")
    latency_ms: Annotated[
        int, Meta(ge=0, le=1000, description="Sound buffered against uneven arrival; increased when necessary.")
    ] = 60

    def words(self, rate: int, channels: int) -> list[str]:
        """Return ``command`` for such sound."""
        values = {"{rate}": str(rate), "{channels}": str(channels), "{device}": self.device}
        words = list(self.command)
        for name, value in values.items():
            words = [word.replace(name, value) for word in words]
        return words


class Media(Section, frozen=True, kw_only=True):
    """Pictures and sound, to and from operators."""

    video_publisher: Annotated[VideoPublisher, doc("Pictures out.")] = VideoPublisher()
    audio_publisher: Annotated[AudioPublisher, doc("Sound out.")] = AudioPublisher()
    audio_receiver: Annotated[AudioReceiver, doc("Sound in.")] = AudioReceiver()


class Playback(Section, frozen=True, kw_only=True):
    """Where sounds are and what plays them; decoded ones are played by the audio receiver's command."""

    retired: ClassVar = {
        **dict.fromkeys(("stop_timeout", "scan_interval"), ONE_VALUE),
        **dict.fromkeys(("cwd", "env"), COMMAND),
        "volume": "clips are played as recorded: set the loudspeaker's volume, or the player's",
    }

    directory: Annotated[File | None, doc("Folder of the sounds; unset: `~/sounds`.")] = None
    player_command: Annotated[Command, doc("Plays wav files; `{file}` stands for the sound, else it comes last.")] = (
        "aplay",
    )


class SoundboardHandler(ServiceSection, frozen=True, kw_only=True):
    """Plays sounds on the robot."""

    topics: Annotated[HandlerTopics, doc("Other names for topics.")] = HandlerTopics()
    playback: Annotated[Playback, doc("Sounds and player.")] = Playback()
