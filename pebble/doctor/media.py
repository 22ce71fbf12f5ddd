"""Checks of camera, microphone and codecs."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from pebble.check_result import CheckResult
from pebble.config import Config
from pebble.contract.encodings import NEED_PYAV
from pebble.doctor import device_names, fail, ok
from pebble.media import pyav

_DEVICE = "services.av_daemon.video.device"
_LIBCAMERA = ("rpicam-vid", "libcamera-vid")

Which = Callable[[str], str | None]


def media(config: Config, devices: Path, which: Which = shutil.which) -> Iterator[CheckResult]:
    """No findings for a robot without camera and microphone. ``devices``: folder of device files."""
    daemon = config.services.av_daemon
    if not daemon.enabled:
        return
    if daemon.video.enabled:
        yield camera(daemon.video.backend, daemon.video.device, devices, which)
    if daemon.audio.enabled and daemon.audio.source != "synthetic":
        yield program("microphone", ("arecord",), "sudo apt install alsa-utils", which)
    yield codecs(config, installed=pyav.installed())
    for name, path in daemon.sockets().items():
        yield shm_socket(f"{name} for the original's scripts", path)


def shm_socket(what: str, path: Path) -> CheckResult:
    """Whether `gstreamer_mirror` can make the socket."""
    folder = path.parent
    if not folder.is_dir():
        return fail(what, f"there is no folder {folder}", f"sudo install -d -o $USER {folder}")
    if not os.access(folder, os.W_OK | os.X_OK):
        return fail(what, f"{folder} is not writable for this user", f"sudo chown $USER {folder}")
    if path.exists() and not path.is_socket():
        return fail(what, f"{path} is a file and no socket", f"rm {path}")
    return ok(what, str(path))


def camera(backend: str, device: str, devices: Path, which: Which) -> CheckResult:
    if backend == "synthetic":
        return ok("camera", "synthetic: needs no device")
    if backend != "v4l2":
        return program("camera", _LIBCAMERA, "sudo apt install rpicam-apps", which)
    names = devices / "v4l"
    path = devices / f"video{device}" if device.isdecimal() else Path(device)
    if "://" in device:
        return ok("camera", "on the network: not checked")
    if not path.exists():
        return device_names.missing("camera", f"{path} does not exist: is it plugged in?", _DEVICE, names)
    if not os.access(path, os.R_OK | os.W_OK):
        return fail("camera", f"{path} is not accessible to this user", "sudo usermod -aG video $USER, log in again")
    return device_names.usable("camera", path, f"{path} readable and writable", _DEVICE, names)


def program(what: str, names: tuple[str, ...], fix: str, which: Which) -> CheckResult:
    """One of ``names`` must be installed."""
    found = next((name for name in names if which(name) is not None), None)
    if found is None:
        return fail(what, f"{' or '.join(names)} is not installed", fix)
    return ok(what, f"uses {found}")


def codecs(config: Config, *, installed: bool) -> CheckResult:
    """H.264 and Opus; missing codecs are an error only if the config selects them."""
    sent = config.services.mqtt_bridge.media
    asked = [name for name in (sent.video_publisher.encoding, sent.audio_publisher.encoding) if name in NEED_PYAV]
    if installed:
        return ok("codecs", "H.264 and Opus are available")
    fix = "pip install 'pebble-robot[media]'"
    if asked:
        return fail("codecs", f"PyAV is not installed, so there is no {' and no '.join(asked)}", fix)
    return ok("codecs", f"PyAV is not installed: no H.264, no Opus ({fix})")
