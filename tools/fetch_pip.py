"""Downloads pip's newest wheel from PyPI into the given folder, and prints its path: for Pythons without ensurepip."""

import hashlib
import json
import os
import ssl
import sys
import urllib.request
from pathlib import Path

INDEX = "https://pypi.org/pypi/pip/json"


def fetch(url: str) -> bytes:
    """Return the content of ``url``; ends the program with one line if the download fails."""
    authorities = os.environ.get("SSL_CERT_FILE") or os.environ.get("PIP_CERT")
    try:
        context = ssl.create_default_context(cafile=authorities)
        with urllib.request.urlopen(url, timeout=30, context=context) as answer:  # noqa: S310 - https, see above
            return bytes(answer.read())
    except OSError as error:
        sys.exit(f"cannot fetch {url}: {error}")


def main(folder: Path) -> None:
    files = json.loads(fetch(INDEX))["urls"]
    wheel = next(file for file in files if file["packagetype"] == "bdist_wheel")
    content = fetch(wheel["url"])
    if hashlib.sha256(content).hexdigest() != wheel["digests"]["sha256"]:
        sys.exit(f"{wheel['url']} does not have the checksum of the index")
    target = folder / wheel["filename"]
    target.write_bytes(content)
    print(target)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
