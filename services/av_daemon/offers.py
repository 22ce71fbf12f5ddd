"""Offers of a robot with a camera and a microphone to operators, and the programs for them."""

from collections.abc import Iterator
from typing import Any

from msgspec.structs import replace

from pebble.config import Config
from pebble.contract.capabilities import CapabilitiesValue
from pebble.extension import Facts, Program
from pebble.services.av_daemon.config import AvDaemon


def offers(config: Config, value: CapabilitiesValue) -> CapabilitiesValue:
    """Return ``value`` with pictures and sound; operators control them only if there is a bridge to request them."""
    devices, controls = config.section(AvDaemon), config.services.mqtt_bridge.enabled
    video, audio = devices.enabled and devices.video.enabled, devices.enabled and devices.audio.enabled
    return replace(
        value,
        video=_completed(value.video, devices.video, ("width", "height", "fps"), video, controls),
        audio=_completed(value.audio, devices.audio, ("rate", "channels"), audio, controls),
    )


def _completed(offer: Any, captured: Any, keys: tuple[str, ...], available: bool, controls: bool) -> Any:
    """Return ``offer``; where it has None for one of ``keys``, it gets the value with which the device captures.

    ``available``: the device is enabled. ``controls``: the bridge is enabled. If both are, operators control it.
    """
    missing = {key: getattr(captured, key) for key in keys if getattr(offer, key) is None}
    return replace(offer, available=available, controls=available and controls, **missing)


def facts(config: Config) -> Facts:
    """Return the lines of the summary about the sockets where programs of the original find pictures and sound."""
    forms = {"video": "pictures", "audio": "sound"}
    sockets = config.section(AvDaemon).sockets().items()
    texts = (f"{forms[name]} at {path}, by examples/gstreamer_sockets.py" for name, path in sockets)
    return Facts(tuple(("for the original's scripts", text) for text in texts))


def camera_programs(config: Config) -> Iterator[Program]:
    """Yield the process that sends pictures to operators while the bridge requests them."""
    return _programs(config, "camera_publisher", "CameraPublisher", config.section(AvDaemon).video.enabled)


def microphone_programs(config: Config) -> Iterator[Program]:
    """Yield the process that sends sound to operators while the bridge requests it."""
    return _programs(config, "audio_publisher", "AudioPublisher", config.section(AvDaemon).audio.enabled)


def loudspeaker_programs(config: Config) -> Iterator[Program]:
    """Yield the process that plays operators' voices while the bridge requests it."""
    return _programs(config, "audio_receiver", "AudioReceiver", config.section(AvDaemon).audio.enabled)


def _programs(config: Config, name: str, service: str, has_device: bool) -> Iterator[Program]:
    if has_device and config.section(AvDaemon).enabled and config.services.mqtt_bridge.enabled:
        shares = ("pebble.extensions.media.frames", "pebble.extensions.media.sound")
        place = f"pebble.services.{name}.service:{service}"
        yield Program(name, place, on_demand=True, preloaded=False, shares=shares)
