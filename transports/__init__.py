"""Pub/sub transports. Everything above works with :class:`Transport`; only :func:`create` knows the kinds.

A folder of this package with a ``transport.py`` is a kind of transport: ``mqtt/transport.py`` declares its class as
``TRANSPORT``. Packages of third parties offer theirs through the entry point group ``pebble.transports``.
"""

from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from pebble.errors import TransportError
from pebble.transports.base import Answer as Answer
from pebble.transports.base import Handler as Handler
from pebble.transports.base import Message as Message
from pebble.transports.base import Outgoing as Outgoing
from pebble.transports.base import QoS as QoS
from pebble.transports.base import State as State
from pebble.transports.base import Subscription as Subscription
from pebble.transports.base import Transport as Transport
from pebble.transports.settings import MqttSettings as MqttSettings
from pebble.transports.settings import TlsSettings as TlsSettings
from pebble.transports.settings import ZenohSettings as ZenohSettings

GROUP = "pebble.transports"


def create(kind: str, client_id: str, settings: Any, *, will: Message | None = None) -> Transport:
    """Return a transport of ``kind``, not yet opened.

    A third party's package offers a kind with ``[project.entry-points."pebble.transports"] mykind = "package:Class"``;
    the class is called as ``Class(client_id, settings, will=…)``.
    """
    module = module_of(kind)
    factory = _entry_point(kind).load() if module is None else import_module(module).TRANSPORT
    transport = factory(client_id, settings, will=will)
    if not isinstance(transport, Transport):
        raise TransportError(f'transport "{kind}" is not a pebble.transports.Transport')
    return transport


def check_kind(kind: str) -> None:
    """Raise TransportError if there is no transport of this ``kind``. Imports no backend."""
    if module_of(kind) is None:
        _entry_point(kind)


def module_of(kind: str) -> str | None:
    """Return the module of one of our own transports; None if ``kind`` is not one of them."""
    return f"{__name__}.{kind}.transport" if kind in _own_kinds() else None


@cache
def _own_kinds() -> frozenset[str]:
    return frozenset(path.parent.name for path in Path(__file__).parent.glob("*/transport.py"))


def _entry_point(kind: str) -> Any:
    from importlib.metadata import entry_points  # several MB, only for robots with a third party's transport

    offered = {point.name: point for point in entry_points(group=GROUP)}
    if kind not in offered:
        raise TransportError(f'no transport "{kind}": known are {", ".join(sorted({*_own_kinds(), *offered}))}')
    return offered[kind]
