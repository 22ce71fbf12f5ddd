"""Checks of camera, microphone and loudspeaker."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from pebble.checks import devices
from pebble.checks.check import CheckResult, failed, ok, warn
from pebble.config import Config

_DEVICE = "services.av_daemon.video.device"
_LIBCAMERA = ("rpicam-vid", "libcamera-vid")


def cameras(config: Config, folder: Path = Path("/dev")) -> Iterator[CheckResult]:
    """Check the camera, if it has one. ``folder``: of device files."""
    daemon = config.services.av_daemon
    if daemon.enabled and daemon.video.enabled:
        yield camera(daemon.video.backend, daemon.video.device, folder)


def microphone(config: Config) -> Iterator[CheckResult]:
    daemon = config.services.av_daemon
    if daemon.enabled and daemon.audio.enabled and daemon.audio.source != "synthetic":
        yield _program(("arecord",), "sudo apt install alsa-utils")


def camera(backend: str, device: str, folder: Path) -> CheckResult:
    if backend == "synthetic":
        return ok("synthetic: needs no device")
    if backend != "v4l2":
        return _program(_LIBCAMERA, "sudo apt install rpicam-apps")
    names = folder / "v4l"
    path = folder / f"video{device}" if device.isdecimal() else Path(device)
    if "://" in device:
        return ok("on the network: not checked")
    if not path.exists():
        return devices.missing(f"{path} does not exist: is it plugged in?", _DEVICE, names)
    if not os.access(path, os.R_OK | os.W_OK):
        return failed(f"{path} is not accessible to this user", "sudo usermod -aG video $USER, log in again")
    return devices.usable(path, f"{path} readable and writable", _DEVICE, names)


def _program(names: tuple[str, ...], fix: str) -> CheckResult:
    """Look for one of ``names``."""
    name = next((name for name in names if shutil.which(name) is not None), None)
    return failed(f"{' or '.join(names)} is not installed", fix) if name is None else ok(f"uses {name}")


def loudspeaker(config: Config) -> Iterator[CheckResult]:
    """Look for the players of sounds and of an operator's voice, if it plays them."""
    services = config.services
    talk_back = services.av_daemon.enabled and services.av_daemon.audio.enabled
    wav, raw = services.soundboard_handler.playback.player_command, services.mqtt_bridge.media.audio_receiver.command
    commands = [wav] * services.soundboard_handler.enabled + [raw] * talk_back
    for name in dict.fromkeys(command[0] for command in commands):
        if shutil.which(name) is not None:
            yield ok(f"uses {name}")
            continue
        install = f"install {name}, or name another player in the config"
        fix = "sudo apt install alsa-utils" if name == "aplay" else install
        yield warn(f"{name} is not installed: nothing can be played", fix)
