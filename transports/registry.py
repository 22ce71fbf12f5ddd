"""Finds a transport by its kind: ours by name, anybody's through the entry point group ``pebble.transports``."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from pebble.errors import TransportError
from pebble.transports.base import Message, Transport

BUILT_IN = {
    "memory": "pebble.transports.memory:MemoryTransport",
    "mqtt": "pebble.transports.mqtt:MqttTransport",
    "zenoh": "pebble.transports.zenoh:ZenohTransport",
}
GROUP = "pebble.transports"


def create(kind: str, client_id: str, settings: Any, *, will: Message | None = None) -> Transport:
    """Make a transport of ``kind``, not yet opened.

    A third party's package offers one with ``[project.entry-points."pebble.transports"] mykind = "package:Class"``;
    the class is called as ``Class(client_id, settings, will=…)``.
    """
    transport = _factory(kind)(client_id, settings, will=will)
    if not isinstance(transport, Transport):
        raise TransportError(f'transport "{kind}" is not a pebble.transports.Transport')
    return transport


def check_kind(kind: str) -> None:
    """Raise TransportError if nobody offers a transport of this ``kind``. Imports no backend."""
    if kind not in BUILT_IN:
        _offered(kind)


def _factory(kind: str) -> Any:
    if kind in BUILT_IN:
        module, _, name = BUILT_IN[kind].partition(":")
        return getattr(import_module(module), name)
    return _offered(kind).load()


def _offered(kind: str) -> Any:
    """A third party's entry point."""
    from importlib.metadata import entry_points  # several MB that only robots with a third party's transport pay for

    offered = {point.name: point for point in entry_points(group=GROUP)}
    if kind not in offered:
        raise TransportError(f'no transport "{kind}": known are {", ".join(sorted({*BUILT_IN, *offered}))}')
    return offered[kind]
