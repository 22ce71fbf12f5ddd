"""Checks of device files: whether they are there, may be used, and will be the same ones after the next start."""

import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path

from pebble.checks.check import CheckResult, failed, ok, warn
from pebble.config import Config

_NUMBERED = re.compile(r"(ttyACM|ttyUSB|video)[0-9]+")  # the number depends on the order of plugging in
_SERIAL_NAMES = Path("/dev/serial")


def missing(text: str, key: str, names: Path) -> CheckResult:
    """Say that the device of config key ``key`` does not exist. ``names``: the folder with links such as by-id/."""
    links = sorted(str(link) for link in names.glob("by-id/*") if not _is_part(link))
    return failed(text, f"ls -l {names / 'by-id'}/" if len(links) != 1 else f"set {key} to {links[0]}")


def usable(path: Path, text: str, key: str, names: Path) -> CheckResult:
    """Say that it can be used; warn if its number may change at the next start, and it has a name that stays."""
    if _NUMBERED.fullmatch(path.name):
        for kind in ("by-id", "by-path"):
            for link in sorted(names.glob(f"{kind}/*")):
                if link.exists() and link.samefile(path):
                    why = f"{text}, but its number depends on the order of plugging in"
                    return warn(why, f"set {key} to {link}")
    return ok(text)


def _is_part(link: Path) -> bool:
    """True if it is another device file of the same camera, such as the one of its metadata."""
    return "-video-index" in link.name and not link.name.endswith("-video-index0")


def serial_ports(config: Config) -> Iterator[CheckResult]:
    for name, line in config.serial_instances().items():
        within = f"instances.{name}." if name else ""
        path = Path(str(line.serial.port))
        yield serial_port(path, f"services.serial_mcu_bridge.{within}serial.port")


def serial_port(path: Path, key: str, names: Path = _SERIAL_NAMES) -> CheckResult:
    """``key``: of the config, which names it; ``names``: the folder with by-id/."""
    try:
        status = path.stat()
    except OSError:
        return missing(f"{path} does not exist: is the MCU plugged in?", key, names)
    if not stat.S_ISCHR(status.st_mode):
        return failed(f"{path} is not a device", f"correct {key}")
    if not os.access(path, os.R_OK | os.W_OK):
        fix = f"sudo usermod -aG $(stat -c %G {path}) $USER, then log in again"
        return failed(f"{path} may only be used by its owner and its group", fix)
    return usable(path, f"{path} readable and writable", key, names)
