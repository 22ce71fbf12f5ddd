"""Downloads pip's newest wheel from PyPI into the given folder, and prints its path: for Pythons without ensurepip."""

import hashlib
import json
import sys
from pathlib import Path
from urllib.parse import urljoin

from download import fetch

INDEX = "https://pypi.org/pypi/pip/json"


def main(folder: Path) -> None:
    files = json.loads(fetch(INDEX))["urls"]
    wheel = next(file for file in files if file["packagetype"] == "bdist_wheel")
    url = urljoin(INDEX, wheel["url"])
    content = fetch(url)
    if hashlib.sha256(content).hexdigest() != wheel["digests"]["sha256"]:
        sys.exit(f"{url} does not have the checksum of the index")
    target = folder / wheel["filename"]
    target.write_bytes(content)
    print(target)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
