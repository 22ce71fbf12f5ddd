"""The operator page of a testbed: ``python -m pebble.extensions.lab.rig.page FIELDS``, JSON with fields of WebSettings.

It prints ``{"url": …}`` once the page can be opened.
"""

import logging
import sys
from pathlib import Path
from typing import Any

import msgspec

from pebble.errors import PebbleError
from pebble.extensions.page.setting import WebSettings
from pebble.runtime.parent import set_up_logging


class Ready(msgspec.Struct):
    """The line that is printed once the page can be opened."""

    url: str


def main(fields: str) -> int:
    from pebble.extensions.page.serve import run  # of packages that may be missing

    def path(kind: type[Any], value: Any) -> Any:
        return Path(value) if issubclass(kind, Path) else value

    def ready(url: str) -> None:
        sys.stdout.write(msgspec.json.encode(Ready(url)).decode() + "\n")
        sys.stdout.flush()

    set_up_logging("INFO")
    try:
        return run(msgspec.json.decode(fields, type=WebSettings, dec_hook=path), on_ready=ready)
    except PebbleError as error:
        logging.getLogger(__name__).error("%s", error)
        return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
