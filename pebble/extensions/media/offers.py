"""Sections of a robot's capabilities: pictures and sound, before a service sends any, and lists of files."""

from msgspec.structs import replace

from pebble import contract as c
from pebble.config import Config
from pebble.contract.capabilities import AudioOffer, CapabilitiesValue, FilesOffer, VideoOffer
from pebble.contract.encodings import ALL_SOUND, ALL_VIDEO
from pebble.extensions.media import pyav
from pebble.extensions.media.config import Media
from pebble.runtime.addresses import Addresses


def offers(config: Config, value: CapabilitiesValue) -> CapabilitiesValue:
    """Return ``value`` with offers of pictures and sound that are not available yet."""
    addresses = Addresses(config)
    return replace(value, video=_video(config, addresses), audio=_audio(config, addresses))


def _video(config: Config, addresses: Addresses) -> VideoOffer:
    sent = config.section(Media).video_publisher  # its keys ``publish_*`` count before the others
    return VideoOffer(
        topic=addresses[c.CAMERA].topic,
        command_topic=addresses[c.VIDEO_CONTROL].topic,
        flag_topic=addresses[c.MQTT_VIDEO].topic,
        overlays_topic=addresses[c.VIDEO_OVERLAYS].topic,
        width=sent.publish_width or sent.width,
        height=sent.publish_height or sent.height,
        fps=sent.publish_fps or sent.target_fps or sent.fps,
        encoding=sent.encoding,
        encodings=list(pyav.available(ALL_VIDEO)),
    )


def _audio(config: Config, addresses: Addresses) -> AudioOffer:
    sent = config.section(Media).audio_publisher
    return AudioOffer(
        topic=addresses[c.AUDIO].topic,
        uplink_topic=addresses[c.AUDIO_STREAM].topic,
        command_topic=addresses[c.AUDIO_CONTROL].topic,
        flag_topic=addresses[c.MQTT_AUDIO].topic,
        rate=sent.rate,
        channels=sent.channels,
        encoding=sent.encoding,
        encodings=list(pyav.available(ALL_SOUND)),
    )


def files_offer(config: Config, command: c.Channel, files: c.Channel, status: c.Channel, enabled: bool) -> FilesOffer:
    """Return the offer of sounds or scripts, which is available and obeys commands if ``enabled``."""
    addresses = Addresses(config)
    return FilesOffer(
        available=enabled,
        controls=enabled,
        command_topic=addresses[command].topic,
        files_topic=addresses[files].topic,
        status_topic=addresses[status].topic,
    )
