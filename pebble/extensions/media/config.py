"""The config sections of pictures and sound towards operators, and kinds of values that media services share."""

from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from pebble.config.types import (
    BY_CONTRACT,
    ONE_VALUE,
    Command,
    Count,
    Section,
    Topic,
    doc,
)
from pebble.contract.encodings import SoundEncoding, VideoEncoding

Pixels = Annotated[int, Meta(ge=1, le=16384)]
FramesPerSecond = Annotated[float, Meta(gt=0, le=1000)]
Rotation = Annotated[Literal[0, 90, 180, 270], Meta(extra={"circle": 360, "unlike": 0})]
SampleRate = Annotated[int, Meta(ge=4000, le=384_000)]
AudioChannels = Annotated[int, Meta(ge=1, le=8)]

_FRAMES = "pictures and sound use the robot's own shared memory, found by transport.run_dir"
_SOURCE = "every frame has its own size and format"
_INPUT = {"input_shm": _FRAMES, "input_retry_seconds": _FRAMES}


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
        """Return the words of ``command`` for sound of this rate and number of channels, to start the player."""
        rated = (word.replace("{rate}", str(rate)).replace("{channels}", str(channels)) for word in self.command)
        return [word.replace("{device}", self.device) for word in rated]


class Media(Section, frozen=True, kw_only=True):
    """Pictures and sound, to and from operators."""

    video_publisher: Annotated[VideoPublisher, doc("Pictures out.")] = VideoPublisher()
    audio_publisher: Annotated[AudioPublisher, doc("Sound out.")] = AudioPublisher()
    audio_receiver: Annotated[AudioReceiver, doc("Sound in.")] = AudioReceiver()


class HandlerTopics(Section, frozen=True, kw_only=True):
    """Other names for a handler's three topics."""

    command: Annotated[Topic | None, doc("Instead of the contract's incoming command topic.")] = None
    files: Annotated[Topic | None, doc("Instead of the contract's list of files.")] = None
    status: Annotated[Topic | None, doc("Instead of the contract's status.")] = None
