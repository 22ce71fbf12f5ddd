"""The Zenoh hub as a process of a robot: ``python -m pebble.hub SETTINGS``, started by the launcher.

The hub itself knows nothing of launchers; this adds what pebble.process adds to services, without what it imports.
"""

from __future__ import annotations

import logging
import signal
import sys
import threading
from pathlib import Path

import msgspec

from pebble.errors import PebbleError
from pebble.launched import ALIVE_PERIOD_S, Notifier, set_up_logging
from pebble.transports.settings import ZenohSettings
from pebble.transports.zenoh_hub import ZenohHub

log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    set_up_logging("INFO")
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    try:
        _run(_settings(arguments), stop)
    except PebbleError as error:
        log.error("%s", error)
        return 1
    return 0


def _settings(arguments: list[str]) -> ZenohSettings:
    if len(arguments) != 1:
        raise PebbleError("usage: python -m pebble.hub SETTINGS (JSON, as the launcher writes it)")
    try:
        return msgspec.json.decode(arguments[0], type=ZenohSettings, dec_hook=lambda _kind, text: Path(text))
    except msgspec.DecodeError as error:
        raise PebbleError(f"settings of the hub: {error}") from None


def _run(settings: ZenohSettings, stop: threading.Event) -> None:
    notify = Notifier()
    hub = ZenohHub(settings).open()
    try:
        notify.ready()
        while not stop.wait(ALIVE_PERIOD_S):
            notify.alive()
    finally:
        hub.close()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
