"""The operator page of a testbed: ``python -m pebble.extensions.lab.rig.page FIELDS``, JSON with fields of WebSettings.

It prints the page's address once the page can be opened.
"""

import logging
import sys
from pathlib import Path
from typing import Any

import msgspec

from pebble.errors import PebbleError
from pebble.extensions.page.setting import WebSettings
from pebble.runtime.parent import set_up_logging


def main(fields: str) -> int:
    """Serve the page until a signal ends it; return the exit code."""
    from pebble.extensions.page.serve import run  # here, as it imports packages that may be missing

    def path(kind: type[Any], value: Any) -> Any:
        return Path(value) if issubclass(kind, Path) else value

    set_up_logging("INFO")
    try:
        settings = msgspec.json.decode(fields, type=WebSettings, dec_hook=path)
        return run(settings, on_ready=lambda url: print(url, flush=True))  # noqa: T201
    except PebbleError as error:
        logging.getLogger(__name__).error("%s", error)
        return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
