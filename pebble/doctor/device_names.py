"""Names of devices that stay: the number of ``ttyACM0`` or ``video0`` depends on the order of plugging in."""

import re
from pathlib import Path

from pebble.check_result import CheckResult
from pebble.doctor import fail, ok, warn

_NUMBERED = re.compile(r"(ttyACM|ttyUSB|video)[0-9]+")


def missing(what: str, text: str, key: str, names: Path) -> CheckResult:
    """The device of config key ``key`` does not exist. ``names``: the folder with links such as by-id/."""
    there = sorted(str(link) for link in names.glob("by-id/*") if not _is_part(link))
    fix = f"ls -l {names / 'by-id'}/" if len(there) != 1 else f"set {key} to {there[0]}"
    return fail(what, text, fix)


def usable(what: str, path: Path, text: str, key: str, names: Path) -> CheckResult:
    """It can be used; a warning if it may be another device after the next start, and has a name that stays."""
    if _NUMBERED.fullmatch(path.name):
        for kind in ("by-id", "by-path"):
            for link in sorted(names.glob(f"{kind}/*")):
                if link.exists() and link.samefile(path):
                    why = f"{text}, but its number depends on the order of plugging in"
                    return warn(what, why, f"set {key} to {link}")
    return ok(what, text)


def _is_part(link: Path) -> bool:
    """Whether it is another device file of the same camera, such as the one of its metadata."""
    return "-video-index" in link.name and not link.name.endswith("-video-index0")
