"""Vendored JavaScript of the operator page: ``--check`` its hashes offline, or ``--update NAME VERSION`` from npm.

``vendor.json`` lists every file: package, version, npm's integrity of the tarball, path inside, and the file's own
sha256. ``--axe FOLDER`` downloads axe-core, which only tests use, into a folder unless it is there.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import io
import json
import os
import sys
import tarfile
from pathlib import Path
from typing import Any

from download import fetch

REGISTRY = "https://registry.npmjs.org"
VENDOR = Path(__file__).resolve().parent.parent / "pebble" / "web" / "static" / "vendor"
LIST, LICENSES = "vendor.json", "LICENSES"
#: Browsers resolve no bare imports, and the page's security policy forbids an inline import map.
REWRITTEN = {b'from"preact"': b'from"./preact.mjs"'}
AXE_VERSION = "4.14.1"
AXE_SHA512 = "FHfa+lmNjQZfJz1q8wKqIDwC6DExcHt/pkjNQb09a3NPjCKg2rhu5qb2S4r76ASyFNNtuFooJpZe37OgudVGtQ=="
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
    meta = json.loads(fetch(f"{_registry()}/{name}/{version}"))
    integrity = meta["dist"]["integrity"]
    content = _tarball(name, version, integrity.removeprefix("sha512-"))
    for entry in entries:
        if entry["name"] == name:
            inside = _rewritten(_member(content, entry["path"]))
            (folder / entry["file"]).write_bytes(inside)
            entry |= {"version": version, "integrity": integrity, "sha256": _sha256(inside), "licence": meta["license"]}
    (folder / LIST).write_text(json.dumps(entries, indent=2) + "\n")
    _write_licence(folder, name, f"{name} {version} ({meta['license']})", _member(content, "LICENSE").decode())


def fetch_axe(folder: Path) -> None:
    """Download axe-core unless this version of it is there."""
    there = folder / "version"
    if there.exists() and there.read_text() == AXE_VERSION:
        return
    print("pebble: fetching axe-core, which checks the operator page for accessibility")
    content = _tarball("axe-core", AXE_VERSION, AXE_SHA512)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "axe.min.js").write_bytes(_member(content, "axe.min.js"))
    there.write_text(AXE_VERSION)  # last: an interrupted run is repeated


def _read(folder: Path) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = json.loads((folder / LIST).read_text())
    return entries


def _registry() -> str:
    spellings = ("npm_config_registry", "NPM_CONFIG_REGISTRY")  # npm accepts both, and sets the first for its scripts
    return next(filter(None, map(os.environ.get, spellings)), REGISTRY).rstrip("/")


def _tarball(name: str, version: str, sha512: str) -> bytes:
    url = f"{_registry()}/{name}/-/{name}-{version}.tgz"
    content = fetch(url)
    if base64.b64encode(hashlib.sha512(content).digest()).decode() != sha512:
        sys.exit(f"{url} does not have the expected checksum")
    return content


def _member(tarball: bytes, path: str) -> bytes:
    with tarfile.open(fileobj=io.BytesIO(tarball)) as archive:
        member = archive.extractfile(f"package/{path}")
        return member.read() if member is not None else sys.exit(f"the package has no {path}")


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
    what.add_argument("--axe", type=Path, metavar="FOLDER")
    chosen = parser.parse_args()
    if chosen.update:
        update(*chosen.update)
    elif chosen.axe:
        fetch_axe(chosen.axe)
    elif found := problems():
        sys.exit("\n".join(found))


if __name__ == "__main__":
    main()
