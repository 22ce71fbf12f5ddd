"""Writes requirements.txt: every package that Pebble installs, pinned, with the hashes of its files.

Under each package stands what it is installed for: tools/locked.sh prints the packages of one kind. So a robot installs
the versions that the tests ran with. The file serves every Python and processor that pyproject.toml allows. It changes
only what no longer fits pyproject.toml; ``lock.py --upgrade`` takes the newest versions of everything.

pip installs from it, not uv: uv reads none of pip's settings, and on a Raspberry Pi these name the index with its
builds.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LOCK = ROOT / "requirements.txt"
#: The extras of each kind of installation. What builds the wheel is in all of them but the tools.
KINDS: dict[str, tuple[str, ...]] = {"robot": ("all",), "demo": ("demo",), "dev": ("dev",)}
TOOLS = "tools"  # a dependency group: uv itself, and what audits and lists packages
EVERYTHING = ("--all-extras", "--group", TOOLS)
HEADER = "# Written by make lock from pyproject.toml. What is installed of it: tools/locked.sh\n"
NAME = re.compile(r"^[a-z0-9][a-z0-9._-]*(?===)", re.MULTILINE)


def compiled(*words: str) -> str:
    """Return the packages that uv chooses for ``words``: its arguments, such as files of requirements and options.

    The argument ``-`` stands for what builds the wheel. Ends the program if uv cannot choose.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    builds = "\n".join(project["build-system"]["requires"])  # uv's input, read for the argument "-"
    command = [sys.executable, "-m", "uv", "pip", "compile", "--no-config", "--quiet", "--universal"]
    command += ["--python-version", "3.11", "--no-header", "--no-annotate"]
    command += ["--no-emit-package", "colorama"]  # of packages that also run on Windows
    done = subprocess.run([*command, *words], cwd=ROOT, input=builds, text=True, stdout=subprocess.PIPE, check=False)
    if done.returncode != 0:
        sys.exit("requirements.txt: uv could not choose the packages, see above")
    return done.stdout


def main() -> None:
    """Choose the packages of everything, then note at each the kinds of installation that need it."""
    upgrade = ["--upgrade"] if "--upgrade" in sys.argv[1:] else []
    compiled("pyproject.toml", "-", *EVERYTHING, "--generate-hashes", "--output-file", str(LOCK), *upgrade)
    text = LOCK.read_text()
    within = ("--constraint", str(LOCK))  # the versions that were chosen above
    kinds: dict[str, set[str]] = {}  # by kind of installation: the names of its packages
    for kind, extras in KINDS.items():
        options = [f"--extra={extra}" for extra in extras]
        kinds[kind] = set(NAME.findall(compiled("pyproject.toml", "-", *within, *options)))
    kinds[TOOLS] = set(NAME.findall(compiled("--group", TOOLS, *within)))
    packages = re.split(r"^(?=[a-z0-9])", text, flags=re.MULTILINE)
    for number, package in enumerate(packages):
        if name := NAME.match(package):
            used = " ".join(kind for kind, names in kinds.items() if name[0] in names)
            packages[number] = f"{package.rstrip()}\n    # for {used}\n"
    LOCK.write_text(HEADER + "".join(packages))


if __name__ == "__main__":
    main()
