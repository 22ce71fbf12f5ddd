"""The Zenoh hub: a part of a robot's announcer, or a process by ``python -m pebble.runtime.hub SETTINGS``.

SETTINGS is JSON with the fields of :class:`pebble.transports.ZenohSettings`; only ``run_dir`` is required.
"""

import logging
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

import msgspec

from pebble.contract import CHANNELS, INCOMING, Kind
from pebble.contract.names import BY
from pebble.errors import PebbleError, TransportError
from pebble.runtime.parent import ALIVE_PERIOD_S, Notifier, set_up_logging
from pebble.runtime.signals import EndSignal
from pebble.transports.settings import ZenohSettings
from pebble.transports.zenoh.hub import ZenohHub
from pebble.transports.zenoh.hub.admission import Admission

log = logging.getLogger(__name__)

_ANY: Final = "+/+/+"  # component
#: Where wills are allowed: not on commands and actions, which happen once, known or unknown; but on flags.
WILLS: Final = (
    (f"{_ANY}/{INCOMING}/#", False),
    (f"{_ANY}/{INCOMING}/flags/#", True),
    *((channel.filter(_ANY), False) for channel in CHANNELS if channel.kind is Kind.ACTION),
)
#: Nothing is retained where the sender's account stands in the topic.
UNRETAINED: Final = (f"{_ANY}/{INCOMING}/{BY}/#",)


def main(arguments: list[str]) -> int:
    """Run a hub with the settings in the arguments; return the exit code."""
    set_up_logging("INFO")
    stop = EndSignal()
    try:
        run_hub(_settings(arguments), stop)
    except PebbleError as error:
        log.error("%s", error)
        return 1
    return 0


def run_hub(settings: ZenohSettings, stop: EndSignal | threading.Event) -> None:
    """Run a hub until ``stop`` is set. Raises TransportError if it cannot open."""
    notify = Notifier()
    with open_hub(settings) as hub:
        notify.ready()
        while not stop.wait(ALIVE_PERIOD_S):
            notify.alive()
            hub.look()


@contextmanager
def open_hub(settings: ZenohSettings) -> Iterator[ZenohHub]:
    """Give a hub that is open during the ``with`` block. Raises TransportError if it cannot open."""
    settings = replace(settings, wills=(*WILLS, *settings.wills), unretained=UNRETAINED)
    hub = ZenohHub(settings, _accounts(settings)).open()
    try:
        yield hub
    finally:
        if hub.refused or hub.refused_wills:
            log.info("refused in all: %d retained messages, %d wills", hub.refused, hub.refused_wills)
        hub.close()


def _accounts(settings: ZenohSettings) -> Admission | None:
    """Return the admission of accounts of other machines, by the file ``transport.access``; None without that file."""
    if settings.access is None:
        return None
    from pebble.extension import ours, part  # only who needs it pays for it

    for extension in ours():
        if extension.accounts:
            accounts: Admission = part(extension.accounts)(settings.access, settings.wills, settings.unretained)
            return accounts
    raise TransportError("transport.access: is of the extension fleet, which is not installed")


def _settings(arguments: list[str]) -> ZenohSettings:
    if len(arguments) != 1:
        raise PebbleError("usage: python -m pebble.runtime.hub SETTINGS (JSON: the fields of ZenohSettings)")
    try:
        return msgspec.json.decode(arguments[0], type=ZenohSettings, dec_hook=lambda _kind, text: Path(text))
    except msgspec.DecodeError as error:
        raise PebbleError(f"settings of the hub: {error}") from None


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
