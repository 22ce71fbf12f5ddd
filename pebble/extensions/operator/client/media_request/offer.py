"""The media that a robot offers, by its capabilities. Pure."""

from collections.abc import Collection, Sequence
from typing import Any, Final, Literal, NamedTuple

from pebble.contract import AUDIO, AUDIO_CONTROL, CAMERA, MQTT_AUDIO, MQTT_VIDEO, VIDEO_CONTROL, Channel
from pebble.extensions.operator.client.robot_topics import PLACES, names, section_of

Medium = Literal["video", "audio"]

#: The channels of a medium, for which capabilities may name topics.
CHANNELS: Final[dict[Medium, tuple[Channel, ...]]] = {
    "video": (CAMERA, VIDEO_CONTROL, MQTT_VIDEO),
    "audio": (AUDIO, AUDIO_CONTROL, MQTT_AUDIO),
}


BEST_FIRST: Final[dict[Medium, tuple[str, ...]]] = {"video": ("h264", "pbvd", "json"), "audio": ("opus", "pcm")}


class Words(NamedTuple):
    """The words for a medium in messages to people."""

    lacking: str  # the robot does not have it
    fixed: str  # the robot has it, and takes no requests for it
    name: str


WORDS: Final[dict[Medium, Words]] = {
    "video": Words("it has no camera", "its camera cannot be switched on from here", "pictures"),
    "audio": Words("it has no sound", "its sound cannot be switched on from here", "sound"),
}


def offered(capabilities: dict[str, Any], medium: Medium) -> tuple[str, ...]:
    """Return the encodings that may be requested.

    Empty for robots that list none; requests to them name no encoding.
    """
    listed = section_of(capabilities, medium).get("encodings")
    if not isinstance(listed, list):
        return ()
    return tuple(name for name in listed if isinstance(name, str))


def refusal(ref: str, capabilities: dict[str, Any], medium: Medium) -> str:
    """Return why this robot's pictures, or its sound, cannot be requested; empty if they can.

    Capabilities come from the network: if they name topics of another component or channel, they are ignored.
    """
    if not capabilities:
        return "it has published no capabilities yet"
    section, words = section_of(capabilities, medium), WORDS[medium]
    if section.get("available") is not True:
        return words.lacking
    if section.get("controls") is not True:
        return words.fixed
    for channel in CHANNELS[medium]:
        _, key = PLACES[channel]
        if section.get(key) is not None and not names(ref, section[key], channel):
            return f"its capabilities name a topic for {words.name} that is not its own ({key})"
    return ""


def best(medium: Medium, encodings: Collection[str], viewers: Sequence[frozenset[str]]) -> str | None:
    """Return the encoding that the most viewers can show, at a tie the best one; None if the robot lists none."""
    readable = [encoding for encoding in BEST_FIRST[medium] if encoding in encodings]
    return max(readable, key=lambda encoding: sum(encoding in can for can in viewers), default=None)
