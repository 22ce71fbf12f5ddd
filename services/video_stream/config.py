"""A third party's streaming program: its config section, what it offers, and the process that runs it."""

import re
from collections.abc import Iterator
from typing import Annotated, ClassVar

from msgspec.structs import replace

from pebble.config import Config
from pebble.config.hosts import HostError, split
from pebble.config.problems import Path
from pebble.config.reader import Reader, Rule
from pebble.config.types import COMMAND, Command, ServiceSection, doc
from pebble.contract.capabilities import CapabilitiesValue, offered
from pebble.extension import Program


class VideoStream(ServiceSection, frozen=True, kw_only=True):
    """Runs a third party's streaming program while operators request video."""

    retired: ClassVar = dict.fromkeys(("cwd", "env"), COMMAND)

    command: Annotated[Command, doc("The program and its arguments, without a shell; required where enabled.")] = ()
    webrtc_url: Annotated[str | None, doc("Where its pictures are shown; operator pages find it in the status.")] = None


def _check(reader: Reader, stream: VideoStream, path: Path) -> VideoStream:
    """Check the address, which every operator receives: a login in it would be no secret."""
    if stream.enabled and not stream.command:
        reader.notes.doubt((*path, "command"), "is missing, write the program that streams the video")
    if stream.webrtc_url is None:
        return stream
    public = _without_login(stream.webrtc_url)
    if public != stream.webrtc_url:
        reader.notes.warning((*path, "webrtc_url"), "its login is left out, because the address is published")
    try:
        if public.lower().startswith(("http://", "https://")):
            split(public)
    except HostError as error:
        reader.notes.warning((*path, "webrtc_url"), f"no page can show it: {error}")
    return replace(stream, webrtc_url=public)


def _without_login(url: str) -> str:
    """Return ``url`` without user and password, if they can be told from its path."""
    before, slashes, after = url.partition("://")
    authority = re.split(r"[/?#\s]", after, maxsplit=1)[0]
    if "@" in authority:
        return f"{before}{slashes}{authority.rpartition('@')[2]}{after[len(authority) :]}"
    # An @ behind the authority is part of a path. But if the authority has a colon without a port behind it, a password
    # begins there that has a slash in it, and the @ is the end of the login.
    has_password = re.search(r":(?!\d*$)", authority)
    if "@" in after and has_password:
        return f"{before}{slashes}{after.rpartition('@')[2]}"
    return url


RULES: tuple[Rule, ...] = ((VideoStream, _check),)


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
