"""Writes build/release: wheel, sdist, Debian package, SBOM, RELEASE.json and SHA256SUMS.

What is built depends on the files of the checkout and on SOURCE_DATE_EPOCH, by default the time of the commit: twice
built is equal, byte for byte. Signing is a step on another machine: docs/life-of-a-robot.md.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
INTO = ROOT / "build" / "release"
SHARED = "usr/share/pebble/release"  # below the root of a robot: its first release
HELP = "usr/share/pebble/help"  # what `pebble --help` prints while there is no slot
UNITS = "usr/lib/systemd/system"
#: The Debian package: where each file of the checkout goes, and its mode.
PACKAGE = (
    ("configs/debian/pebble", "usr/bin/pebble", 0o755),
    ("configs/slot/pebble-slot", "usr/lib/pebble/pebble-slot", 0o755),
    ("configs/systemd/pebble.service", f"{UNITS}/pebble.service", 0o644),
    ("configs/debian/slot.conf", f"{UNITS}/pebble.service.d/slot.conf", 0o644),
    ("configs/debian/pebble-slot.service", f"{UNITS}/pebble-slot.service", 0o644),
    ("configs/debian/sysusers.conf", "usr/lib/sysusers.d/pebble.conf", 0o644),
    ("configs/debian/tmpfiles.conf", "usr/lib/tmpfiles.d/pebble.conf", 0o644),
    ("configs/systemd/50-pebble.rules", "usr/share/polkit-1/rules.d/50-pebble.rules", 0o644),
    ("configs/completion/pebble", "usr/share/bash-completion/completions/pebble", 0o644),
    ("configs/completion/_pebble", "usr/share/zsh/vendor-completions/_pebble", 0o644),
    ("configs/completion/pebble.fish", "usr/share/fish/vendor_completions.d/pebble.fish", 0o644),
    ("LICENSE", "usr/share/doc/pebble-robot/copyright", 0o644),
    ("README.md", "usr/share/doc/pebble-robot/README.md", 0o644),
    *((f"configs/debian/{name}", f"DEBIAN/{name}", 0o755) for name in ("postinst", "prerm", "postrm")),
    ("configs/debian/triggers", "DEBIAN/triggers", 0o644),
)


def copied(source: Path, into: Path) -> None:
    """Copy the files that git tracks or would add; a checkout has others, such as those that builds leave behind."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=source, stdout=subprocess.PIPE, check=True).stdout.decode().split("\0")
    for name in filter(None, names):
        if (source / name).exists():
            target = into / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source / name, target, follow_symlinks=False)
            if not target.is_symlink():
                target.chmod(0o755 if os.access(source / name, os.X_OK) else 0o644)


def normal(sdist: Path, epoch: int) -> None:
    """Write an sdist again without the times and owners of its build, which setuptools leaves in it."""
    with tarfile.open(sdist) as archive:
        members = [(member, archive.extractfile(member)) for member in archive.getmembers()]
        tar = io.BytesIO()
        with tarfile.open(fileobj=tar, mode="w", format=tarfile.PAX_FORMAT) as again:
            for member, content in sorted(members, key=lambda pair: pair[0].name):
                member.mtime, member.uid, member.gid, member.uname, member.gname = epoch, 0, 0, "", ""
                member.mode, member.pax_headers = 0o755 if member.mode & 0o100 else 0o644, {}
                again.addfile(member, content)
    with sdist.open("wb") as file, gzip.GzipFile(filename="", mode="wb", fileobj=file, mtime=epoch) as packed:
        packed.write(tar.getvalue())


def manifest(source: Path, version: str, files: list[Path]) -> dict[str, Any]:
    """Return RELEASE.json."""
    settings = json.loads((source / "configs/debian/release.json").read_text())
    project = tomllib.loads((source / "pyproject.toml").read_text())["project"]
    return {
        "version": version,
        "sequence": settings["sequence"],
        "from": settings["from"],
        "python": project["requires-python"],
        "files": {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files},
        "keys": settings["keys"],
    }


def package(source: Path, version: str, release: list[Path], into: Path) -> Path:
    """Build the Debian package with these files as its first release; return its path."""
    tree = source / "build" / "package"
    control = (source / "configs/debian/control").read_text().replace("@VERSION@", f"{version}-1")
    (tree / "DEBIAN").mkdir(parents=True)
    (tree / "DEBIAN" / "control").write_text(control)
    files = [(source / name, tree / where, mode) for name, where, mode in PACKAGE]
    files += [(path, tree / SHARED / path.name, 0o644) for path in release]
    for path, target, mode in files:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
        target.chmod(mode)
    command = [sys.executable, "-m", "pebble.cli", "--help"]
    (tree / HELP).write_bytes(subprocess.run(command, cwd=source, stdout=subprocess.PIPE, check=True).stdout)
    (tree / "usr/sbin").mkdir()
    (tree / "usr/sbin/pebble-slot").symlink_to("../lib/pebble/pebble-slot")
    installed = sorted(
        path for path in tree.rglob("*") if path.is_file() and not path.is_symlink() and "DEBIAN" not in path.parts
    )
    sums = [f"{hashlib.md5(path.read_bytes()).hexdigest()}  {path.relative_to(tree)}\n" for path in installed]  # noqa: S324
    (tree / "DEBIAN" / "md5sums").write_text("".join(sums))
    deb = into / f"pebble-robot_{version}-1_all.deb"
    # One thread: xz divides its input by their number.
    command = ["dpkg-deb", "--root-owner-group", "--threads-max=1", "-Zxz", "--build", str(tree), str(deb)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return deb


def build(source: Path, into: Path, sbom: Path | None = None) -> str:
    """Build the release of a folder that :func:`copied` wrote; return its version. Reads ``SOURCE_DATE_EPOCH``."""
    shutil.rmtree(into, ignore_errors=True)
    into.mkdir(parents=True)
    (version,) = re.findall(r'^__version__ = "(.+)"$', (source / "pebble/version.py").read_text(), re.MULTILINE)
    for kind in ("--sdist", "--wheel"):
        command = [sys.executable, "-m", "build", kind, "--no-isolation", "--outdir", str(into), str(source)]
        built = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
        if built.returncode != 0:
            sys.exit(built.stdout)
        shutil.rmtree(source / "build", ignore_errors=True)  # what setuptools leaves
    (sdist,), (wheel,) = into.glob("*.tar.gz"), into.glob("*.whl")
    normal(sdist, int(os.environ["SOURCE_DATE_EPOCH"]))  # without the times and owners of this build
    lock = into / "robot.txt"
    locked = subprocess.run(["sh", source / "tools/locked.sh", "robot"], stdout=subprocess.PIPE, check=True)
    lock.write_bytes(locked.stdout)
    release = into / "RELEASE.json"
    release.write_text(json.dumps(manifest(source, version, [wheel, lock]), indent=1) + "\n")
    package(source, version, [release, lock, wheel], into)
    if sbom is not None:
        shutil.copyfile(sbom, into / sbom.name)
    sums = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in sorted(into.iterdir())]
    (into / "SHA256SUMS").write_text("".join(sums))
    return version


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--sbom", type=Path, help="goes with it; tools/sbom.py writes it")
    parser.add_argument("--into", type=Path, default=INTO)
    options = parser.parse_args()
    git = subprocess.run(["git", "log", "-1", "--format=%ct"], cwd=ROOT, capture_output=True, text=True, check=True)
    os.environ.setdefault("SOURCE_DATE_EPOCH", git.stdout.strip())
    os.umask(0o022)
    with tempfile.TemporaryDirectory() as folder:
        copied(ROOT, Path(folder))
        version = build(Path(folder), options.into.resolve(), options.sbom)
    for path in sorted(options.into.iterdir()):
        print(f"{path.stat().st_size:>9}  {path}")
    if subprocess.run(["git", "status", "--porcelain"], cwd=ROOT, capture_output=True, check=True).stdout:
        print("These files have changes that are in no commit.")
    print(f"Pebble {version}. Sign it where the key is: minisign -S -m RELEASE.json SHA256SUMS")


if __name__ == "__main__":
    main()
