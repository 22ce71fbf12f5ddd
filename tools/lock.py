"""Writes requirements/*.txt: every package that Pebble installs, pinned, with the hashes of its files.

``dev.txt`` has everything; the others are parts of it, so a robot installs the versions that the tests ran with. A file
serves every Python and processor that pyproject.toml allows. ``lock.py`` changes only what no longer fits
pyproject.toml, ``lock.py --upgrade`` takes the newest versions of everything.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "requirements"
#: The extras of each file; the first one constrains the others. What builds the wheel is in all of them.
LOCKS: dict[str, tuple[str, ...]] = {
    "dev": ("dev", "demo", "bench", "flash", "media", "web", "record", "archive", "foxglove"),
    "robot": ("media", "record", "web"),
    "demo": ("demo",),
    "bench": ("bench",),
}
TOOLS = "tools"  # a dependency group: uv itself, and what audits
UV = (
    *("uv", "pip", "compile", "--no-config", "--quiet", "--universal", "--python-version", "3.11", "--generate-hashes"),
    *("--no-emit-package", "colorama"),  # of packages that also run on Windows
    *("--no-header", "--annotation-style", "line"),
)
HEADER = "# Written by make lock from pyproject.toml.\n# pip install --require-hashes -r requirements/{name}.txt\n"


def write(name: str, *what: str, upgrade: bool) -> None:
    """Write one file; its present versions stay if they can, unless ``upgrade``."""
    path = FOLDER / f"{name}.txt"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    builds = "\n".join(project["build-system"]["requires"])  # read where ``what`` has a dash
    command = [sys.executable, "-m", *UV, "--output-file", str(path), *(["--upgrade"] if upgrade else []), *what]
    if subprocess.run(command, cwd=ROOT, input=builds, text=True, check=False).returncode != 0:
        sys.exit(f"requirements/{name}.txt is as it was: uv could not choose the packages, see above")
    path.write_text(HEADER.format(name=name) + path.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--upgrade", action="store_true")
    upgrade = parser.parse_args().upgrade
    FOLDER.mkdir(exist_ok=True)
    for name, extras in LOCKS.items():
        wanted = [word for extra in extras for word in ("--extra", extra)]
        within = [] if name == "dev" else ["--constraint", "requirements/dev.txt"]
        write(name, "pyproject.toml", "-", *wanted, *within, upgrade=upgrade)
    write(TOOLS, "--group", TOOLS, upgrade=upgrade)


if __name__ == "__main__":
    main()
