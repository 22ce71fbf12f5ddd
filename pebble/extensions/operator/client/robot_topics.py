"""The robot topics that operators' programs subscribe to, and those that capabilities may name. Pure."""

from typing import Any

from pebble import contract as c
from pebble.contract import OUTGOING, channel_of
from pebble.contract.identity import parse_topic
from pebble.errors import TransportError
from pebble.transports.topics import check_topic

#: What is shown of every component, and what only of one that is open.
FLEET = (
    c.ONLINE,
    c.CAPABILITIES,
    c.STATUS,
    c.ESTOP_STATE,
    c.CONTROL_STATE,
    c.LINK,
    c.CHARGING_STATUS,
    c.CHARGING_LEVEL,
    c.AUTONOMY_STATUS,
    c.MEDIA_STATUS,
)
SYNONYMS = tuple(channel for channel in c.CHANNELS if channel.synonym_of is not None)
WATCHED = tuple(
    channel
    for channel in c.CHANNELS
    if channel.direction == OUTGOING
    and channel.payload is not bytes
    and channel.remote
    and channel not in FLEET
    and channel not in SYNONYMS
    and channel.kind is not c.Kind.EVENT
)
#: Flags, by the section of the capabilities that may name another topic for it.
FLAGS = {"": c.REMOTE_MIRROR, "audio": c.MQTT_AUDIO, "video": c.MQTT_VIDEO}
#: Where capabilities may name another topic for a channel: section and key.
PLACES: dict[c.Channel, tuple[str, str]] = {
    **{flag: (section, "flag_topic") for section, flag in FLAGS.items()},
    c.DRIVE: ("drive", "topic"),
    c.LIGHTS_SOLID: ("lights", "solid_topic"),
    c.LIGHTS_FLASH: ("lights", "flash_topic"),
    c.SOUNDBOARD_COMMAND: ("soundboard", "command_topic"),
    c.SOUNDBOARD_FILES: ("soundboard", "files_topic"),
    c.SOUNDBOARD_STATUS: ("soundboard", "status_topic"),
    c.AUTONOMY_COMMAND: ("autonomy", "command_topic"),
    c.AUTONOMY_FILES: ("autonomy", "files_topic"),
    c.AUTONOMY_STATUS: ("autonomy", "status_topic"),
    c.CAMERA: ("video", "topic"),
    c.VIDEO_CONTROL: ("video", "command_topic"),
    c.VIDEO_OVERLAYS: ("video", "overlays_topic"),
    c.AUDIO: ("audio", "topic"),
    c.AUDIO_CONTROL: ("audio", "command_topic"),
    c.AUDIO_STREAM: ("audio", "uplink_topic"),
    c.TOUCH_SENSORS: ("telemetry", "touch_topic"),
    c.CHARGING_STATUS: ("telemetry", "charging_topic"),
    c.CHARGING_LEVEL: ("telemetry", "charging_level_topic"),
    c.WHEEL_ODOMETRY: ("telemetry", "wheel_odometry_topic"),
    c.IMU: ("telemetry", "imu_topic"),
}


def named_topic(ref: str, capabilities: dict[str, Any], channel: c.Channel) -> str | None:
    """Return the topic that capabilities name for this channel; None if they name none or a forbidden one."""
    section, key = PLACES[channel]
    topic = section_of(capabilities, section).get(key)
    return str(topic) if names(ref, topic, channel) else None


def topic_of(ref: str, capabilities: dict[str, Any], channel: c.Channel) -> str:
    """Return the topic that capabilities name for this channel, else the channel's own."""
    return named_topic(ref, capabilities, channel) or channel.topic(ref)


def section_of(capabilities: dict[str, Any], name: str) -> dict[str, Any]:
    """Return a section of capabilities, or a nested one: ``system.reboot``. Empty if there is none."""
    section: Any = capabilities
    for level in name.split("."):
        section = section.get(level) if isinstance(section, dict) else None
    return section if isinstance(section, dict) else {}


def own_topic(ref: str, topic: object, direction: str) -> bool:
    """True if ``topic`` belongs to ``ref``, in that direction, and is valid. Others in capabilities are ignored."""
    if not isinstance(topic, str) or not topic.startswith(f"{ref}/{direction}/") or parse_topic(topic) is None:
        return False
    try:
        check_topic(topic)
    except TransportError:  # it may not be published to
        return False
    return True


def names(ref: str, topic: object, channel: c.Channel) -> bool:
    """True if capabilities may name this topic for the channel: it is the component's, and no other channel's."""
    if not own_topic(ref, topic, channel.direction):
        return False
    return channel_of(str(topic)[len(ref) + 1 :]) in (None, channel)
