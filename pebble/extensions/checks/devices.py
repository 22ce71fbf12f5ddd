"""Checks of serial ports, camera, microphone and loudspeaker: they exist, and keep their name over a restart."""

import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from pebble.check_result import CheckResult, failed, ok, warn
from pebble.config import Config
from pebble.extensions.media.config import Media
from pebble.services.av_daemon.config import AvDaemon
from pebble.services.soundboard_handler.config import SoundboardHandler

_NUMBERED = re.compile(r"(ttyACM|ttyUSB|video)[0-9]+")  # the number depends on the order of plugging in
_METADATA = re.compile(r"-video-index(?!0$)")  # another device file of the same camera
_SERIAL_NAMES = Path("/dev/serial")
_CAMERA = "services.av_daemon.video.device"
_LIBCAMERA = ("rpicam-vid", "libcamera-vid")


def device(path: Path, what: str, key: str, names: Path) -> CheckResult:
    """Check a device file; warn if its number may change at the next start although it has a lasting name.

    ``what`` is connected to it; ``key`` is the config key that names it; ``names`` is the folder of its lasting names,
    such as by-id/.
    """
    if not path.exists():
        links = sorted(str(link) for link in names.glob("by-id/*") if not _METADATA.search(link.name))
        fix = f"set {key} to {' or '.join(links)}" if links else f"plug it in, then: ls {names}/by-id/*; and set {key}"
        return failed(f"{path} does not exist: is {what} plugged in?", fix)
    if not os.access(path, os.R_OK | os.W_OK):
        fix = f"sudo usermod -aG $(stat -c %G {path}) $USER, then log in again"
        return failed(f"{path} may only be used by its owner and its group", fix)
    text = f"{path} readable and writable"
    if _NUMBERED.fullmatch(path.name):
        for link in (*sorted(names.glob("by-id/*")), *sorted(names.glob("by-path/*"))):
            if link.exists() and link.samefile(path):
                return warn(f"{text}, but its number depends on the order of plugging in", f"set {key} to {link}")
    return ok(text)


def serial_ports(config: Config) -> Iterator[CheckResult]:
    for name, line in config.serial_instances().items():
        within = f"instances.{name}." if name else ""
        yield serial_port(Path(str(line.serial.port)), f"services.serial_mcu_bridge.{within}serial.port")


def serial_port(path: Path, key: str, names: Path = _SERIAL_NAMES) -> CheckResult:
    if path.exists() and not path.is_char_device():
        return failed(f"{path} is not a device", f"correct {key}")
    return device(path, "the MCU", key, names)


def cameras(config: Config, folder: Path = Path("/dev")) -> Iterator[CheckResult]:
    """Check the camera, if the config has one. ``folder``: where device files are."""
    daemon = config.section(AvDaemon)
    if daemon.enabled and daemon.video.enabled:
        yield camera(daemon.video.backend, daemon.video.device, folder)


def camera(backend: str, name: str, folder: Path) -> CheckResult:
    """Check the camera that the config calls ``name``. ``folder``: where device files are."""
    if backend == "synthetic":
        return ok("synthetic: needs no device")
    if backend != "v4l2":
        return _program(_LIBCAMERA, "sudo apt install rpicam-apps")
    if "://" in name:
        return ok("on the network: not checked")
    path = folder / f"video{name}" if name.isdecimal() else Path(name)
    return device(path, what="it", key=_CAMERA, names=folder / "v4l")


def microphone(config: Config) -> Iterator[CheckResult]:
    daemon = config.section(AvDaemon)
    if daemon.enabled and daemon.audio.enabled and daemon.audio.source != "synthetic":
        yield _program(("arecord",), "sudo apt install alsa-utils")


def _program(names: tuple[str, ...], fix: str) -> CheckResult:
    """Check that one of the programs ``names`` is installed."""
    name = next((name for name in names if shutil.which(name) is not None), None)
    return failed(f"{' or '.join(names)} is not installed", fix) if name is None else ok(f"uses {name}")


def loudspeaker(config: Config) -> Iterator[CheckResult]:
    """Check that the players of sounds and of an operator's voice are installed, if the config uses them."""
    devices, sounds = config.section(AvDaemon), config.section(SoundboardHandler)
    commands = []
    if sounds.enabled:
        commands.append(sounds.playback.player_command)
    if devices.enabled and devices.audio.enabled:  # as for the program that plays voices, see loudspeaker_programs
        commands.append(config.section(Media).audio_receiver.command)
    for name in dict.fromkeys(command[0] for command in commands):
        if shutil.which(name) is not None:
            yield ok(f"uses {name}")
            continue
        install = f"install {name}, or name another player in the config"
        fix = "sudo apt install alsa-utils" if name == "aplay" else install
        yield warn(f"{name} is not installed: nothing can be played", fix)
