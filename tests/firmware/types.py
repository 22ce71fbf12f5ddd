"""Type-checks each robot's firmware against the modules of its own board: `make check` runs this.

mypy takes the board's stubs instead of CPython's library, so what a port lacks is not there.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from pebble.extensions.install.flash.boards import FIRMWARE, Firmware
from pebble.extensions.install.flash.sources import firmware_folder
from tests.support import ROOT

STUBS = ROOT / ".venv" / "stubs"
CONFIG = Path(__file__).with_name("mypy.ini")
OURS = Path(__file__).with_name("stubs")


def check(firmware: Firmware) -> str:
    """mypy's complaints about one robot and all it imports, "" if there are none."""
    folder = firmware_folder().resolve()
    stubs = STUBS / firmware.board.port
    files = sorted(path.relative_to(folder).as_posix() for path in (folder / firmware.name).glob("*.py"))
    cache = ROOT / ".mypy_cache" / firmware.board.port
    options = ["--config-file", str(CONFIG), "--custom-typeshed-dir", str(stubs), "--cache-dir", str(cache)]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *options, *files],
        cwd=folder,
        env={"MYPYPATH": f"{folder}:{OURS}:{stubs}"},
        capture_output=True,
        text=True,
        check=False,
    )
    return "" if done.returncode == 0 else done.stdout + done.stderr


def main() -> int:
    complaints = list(filter(None, (check(firmware) for firmware in FIRMWARE.values())))
    sys.stdout.write("".join(complaints))
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
