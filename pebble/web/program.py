"""The operator page as a child process: ``python -m pebble.web.program SETTINGS``, fields of WebSettings as JSON.

Prints one line of JSON, ``{"url": …}``, once the page can be opened, and serves it until SIGTERM or SIGINT.
"""

import logging
import sys
from pathlib import Path
from typing import Any

import msgspec

from pebble.client.page.packages import require_packages
from pebble.client.page.settings import WebSettings
from pebble.errors import PebbleError
from pebble.runtime.parent import set_up_logging

log = logging.getLogger(__name__)


class Ready(msgspec.Struct):
    """What the process reports when the page can be opened."""

    url: str


def main(arguments: list[str]) -> int:
    set_up_logging("INFO")
    try:
        settings = msgspec.json.decode(arguments[0], type=WebSettings, dec_hook=_decode)
        require_packages()
        from pebble.web.serve import run  # of packages that may be missing

        return run(settings, on_ready=_report)
    except (msgspec.MsgspecError, IndexError) as error:
        sys.stderr.write(f"usage: python -m pebble.web.program SETTINGS: {error}\n")
        return 2
    except PebbleError as error:
        log.error("%s", error)
        return 1


def _decode(kind: type[Any], value: Any) -> Any:
    """Paths are strings in JSON."""
    return Path(value) if issubclass(kind, Path) else value


def _report(url: str) -> None:
    sys.stdout.write(msgspec.json.encode(Ready(url)).decode() + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
