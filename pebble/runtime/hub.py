"""Runs the Zenoh hub: in a robot's process pebble.launcher.announcer, or as a program on another machine."""

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Final

from pebble.contract import CHANNELS, INCOMING, Kind
from pebble.contract.names import BY
from pebble.errors import TransportError
from pebble.runtime.parent import ALIVE_PERIOD_S, Notifier
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
    """Yield a hub that is open during the ``with`` block. Raises TransportError if it cannot open."""
    settings = replace(settings, wills=(*WILLS, *settings.wills), unretained=UNRETAINED)
    hub = ZenohHub(settings, _accounts(settings)).open()
    try:
        yield hub
    finally:
        if hub.refused or hub.refused_wills:
            log.info("refused in all: %d retained messages, %d wills", hub.refused, hub.refused_wills)
        hub.close()


def _accounts(settings: ZenohSettings) -> Admission | None:
    """Return the accounts of the file ``transport.access``, by which other machines are admitted; None without it."""
    if settings.access is None:
        return None
    from pebble.extension import ours, part  # only who needs it pays for it

    for extension in ours():
        if extension.accounts:  # names its class of accounts: one extension has one
            accounts: Admission = part(extension.accounts)(settings.access, settings.wills, settings.unretained)
            return accounts
    raise TransportError("transport.access: is of the extension fleet, which is not installed")
