"""Packages of npm's registry, or of the one in $NPM_CONFIG_REGISTRY; npm itself is not needed."""

import base64
import hashlib
import io
import os
import sys
import tarfile

from download import fetch

REGISTRY = "https://registry.npmjs.org"


def registry() -> str:
    spellings = ("npm_config_registry", "NPM_CONFIG_REGISTRY")  # npm accepts both, and sets the first for its scripts
    return next(filter(None, map(os.environ.get, spellings)), REGISTRY).rstrip("/")


def tarball(name: str, version: str, sha512: str) -> bytes:
    """The package, as npm's own ``integrity`` describes it; ends the program with one line if it differs."""
    url = f"{registry()}/{name}/-/{name.rpartition('/')[2]}-{version}.tgz"
    content = fetch(url)
    if base64.b64encode(hashlib.sha512(content).digest()).decode() != sha512:
        sys.exit(f"{url} does not have the expected checksum")
    return content


def members(content: bytes, wanted: str) -> dict[str, bytes]:
    """The files of a package by name; ``wanted`` is one path, or the beginning of several and a star."""
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        paths = [member.name.removeprefix("package/") for member in archive.getmembers() if member.isfile()]
        chosen = [path for path in paths if path == wanted or (wanted.endswith("*") and path.startswith(wanted[:-1]))]
        found = {path: archive.extractfile(f"package/{path}") for path in chosen}
        return {path: file.read() for path, file in found.items() if file is not None} or sys.exit(
            f"the package has no {wanted}"
        )
