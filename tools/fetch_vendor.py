"""Vendored files of the operator page: ``--check`` its hashes offline, or ``--update NAME VERSION`` from npm.

``vendor.json`` lists every file: package, version, npm's integrity of the tarball, path inside, and the file's own
sha256. A file that is made of npm's has the commands that make it, in ``made``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import npm
from download import fetch

VENDOR = Path(__file__).resolve().parent.parent / "pebble" / "web" / "static" / "vendor"
LIST, LICENSES = "vendor.json", "LICENSES"
#: Browsers resolve no bare imports, and the page's security policy forbids an inline import map.
REWRITTEN = {b'from"preact"': b'from"./preact.mjs"'}
_RULER = "=" * 20


def problems(folder: Path = VENDOR) -> list[str]:
    """What differs between the folder and its list."""
    listed = {entry["file"]: entry["sha256"] for entry in _read(folder)}
    found = {path.name for path in folder.iterdir()} - {LIST, LICENSES}
    missing = [f"{name} is missing" for name in sorted(listed.keys() - found)]
    unlisted = [f"{name} is not in {LIST}" for name in sorted(found - listed.keys())]
    differing = [
        f"{name} is not the file of {LIST}"
        for name in sorted(found & listed.keys())
        if _sha256((folder / name).read_bytes()) != listed[name]
    ]
    return missing + unlisted + differing


def update(name: str, version: str, folder: Path = VENDOR) -> None:
    """Replace the files of one package by those of ``version``."""
    entries = _read(folder)
    if not any(entry["name"] == name for entry in entries):
        sys.exit(f"{LIST} lists no package {name}")
    meta = json.loads(fetch(f"{npm.registry()}/{name}/{version}"))
    integrity = meta["dist"]["integrity"]
    content = npm.tarball(name, version, integrity.removeprefix("sha512-"))
    if made := [command for entry in entries if entry["name"] == name for command in entry.get("made", ())]:
        sys.exit("it is made by hand, then its hash and licence are entered:\n" + "\n".join(made))
    for entry in entries:
        if entry["name"] == name:
            inside = _rewritten(_member(content, entry["path"]))
            (folder / entry["file"]).write_bytes(inside)
            entry |= {"version": version, "integrity": integrity, "sha256": _sha256(inside), "licence": meta["license"]}
    (folder / LIST).write_text(json.dumps(entries, indent=2) + "\n")
    _write_licence(folder, name, f"{name} {version} ({meta['license']})", _member(content, "LICENSE").decode())


def _read(folder: Path) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = json.loads((folder / LIST).read_text())
    return entries


def _member(tarball: bytes, path: str) -> bytes:
    return npm.members(tarball, path)[path]


def _rewritten(content: bytes) -> bytes:
    for bare, relative in REWRITTEN.items():
        content = content.replace(bare, relative)
    return content


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _write_licence(folder: Path, name: str, title: str, text: str) -> None:
    path = folder / LICENSES
    sections = path.read_text().split(f"{_RULER} ")[1:] if path.exists() else []
    others = [section for section in sections if not section.startswith(f"{name} ")]
    ordered = sorted([*others, f"{title}\n\n{text.strip()}\n\n"])
    path.write_text("".join(f"{_RULER} {section}" for section in ordered))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--check", action="store_true")
    what.add_argument("--update", nargs=2, metavar=("NAME", "VERSION"))
    chosen = parser.parse_args()
    if chosen.update:
        update(*chosen.update)
    elif found := problems():
        sys.exit("\n".join(found))


if __name__ == "__main__":
    main()
