"""Downloads MicroPython's WebAssembly build, the real interpreter for Node.js, into a folder unless it is there.

The source is npm's registry, or the one in $NPM_CONFIG_REGISTRY; npm is not needed.
"""

import base64
import hashlib
import io
import os
import sys
import tarfile
from pathlib import Path

from download import fetch

REGISTRY = "https://registry.npmjs.org"
PACKAGE, VERSION = "@micropython/micropython-webassembly-pyscript", "1.29.0-6"
# npm's own "integrity" of this version
SHA512 = "kLwGPJFsLY/2aUPmzZxpvauFSmKc0SlJWVvvEttULR0poVQ6W9HV//1fUJyxrGWAxCVDw9aYqJ0LAog0ZLjYVA=="
FILES = ("micropython.mjs", "micropython.wasm", "package.json")


def main(folder: Path) -> None:
    there = folder / "version"
    if there.exists() and there.read_text() == VERSION:
        return
    print("pebble: fetching MicroPython for Node.js")
    folder.mkdir(parents=True, exist_ok=True)
    with tarfile.open(fileobj=io.BytesIO(_tarball())) as archive:
        for name in FILES:
            member = archive.extractfile(f"package/{name}") or sys.exit(f"{PACKAGE} has no {name}")
            (folder / name).write_bytes(member.read())
    there.write_text(VERSION)  # last: an interrupted run is repeated


def _tarball() -> bytes:
    spellings = ("npm_config_registry", "NPM_CONFIG_REGISTRY")  # npm accepts both, and sets the first for its scripts
    registry = next(filter(None, map(os.environ.get, spellings)), REGISTRY)
    url = f"{registry.rstrip('/')}/{PACKAGE}/-/{PACKAGE.partition('/')[2]}-{VERSION}.tgz"
    content = fetch(url)
    if base64.b64encode(hashlib.sha512(content).digest()).decode() != SHA512:
        sys.exit(f"{url} does not have the expected checksum")
    return content


if __name__ == "__main__":
    main(Path(sys.argv[1]))
