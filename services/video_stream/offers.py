"""Offers of a robot with a third party's streaming program, and the process that runs it."""

from collections.abc import Iterator

from msgspec.structs import replace

from pebble.config import Config
from pebble.contract.capabilities import CapabilitiesValue, offered
from pebble.extension import Program
from pebble.services.video_stream.config import VideoStream


def programs(config: Config) -> Iterator[Program]:
    """Yield the process that runs the streaming program while the bridge requests it."""
    if _is_requested(config):
        service, url = "pebble.services.video_stream.service:VideoStream", config.section(VideoStream).webrtc_url
        yield Program("video_stream", service, on_demand=True, webrtc_url=url)


def offers(config: Config, value: CapabilitiesValue) -> CapabilitiesValue:
    """Return ``value`` with the pictures of the streaming program."""
    return replace(value, video=offered(value.video, True)) if _is_requested(config) else value


def _is_requested(config: Config) -> bool:
    section = config.section(VideoStream)
    return section.enabled and bool(section.command) and config.services.mqtt_bridge.enabled
