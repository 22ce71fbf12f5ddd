"""A Zenoh hub alone, for comparisons and tests: ``python -m pebble.extensions.lab.rig.hub SETTINGS``.

SETTINGS is JSON with the fields of :class:`pebble.transports.ZenohSettings`; only ``run_dir`` is required.
"""

import logging
import sys
from pathlib import Path

import msgspec

from pebble.errors import PebbleError
from pebble.runtime.hub import run_hub
from pebble.runtime.parent import set_up_logging
from pebble.runtime.signals import EndSignal
from pebble.transports.settings import ZenohSettings

log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    """Run a hub with the settings in the arguments; return the exit code."""
    set_up_logging("INFO")
    settings = msgspec.json.decode(arguments[0], type=ZenohSettings, dec_hook=lambda _kind, text: Path(text))
    try:
        run_hub(settings, EndSignal())
    except PebbleError as error:
        log.error("%s", error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
