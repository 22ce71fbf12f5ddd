"""Which topics a robot retains, by what it publishes: some brokers send retained messages only to exact names."""

from __future__ import annotations

import re
from collections.abc import Collection

from pebble.contract import CAPABILITIES, CHANNELS, ONLINE, OUTGOING
from pebble.contract.channels import Kind
from pebble.transports import Message

_MOST = 100  # names in one robot's capabilities
_LONGEST = 200  # characters of a robot's base, and of a name below it
_STATES = tuple(one for one in CHANNELS if one.kind is Kind.STATE and one.remote and not one.is_pattern)
_HEARTBEATS = (ONLINE.suffix, *(one.suffix for one in CHANNELS if one.synonym_of == ONLINE.metric))


def retained_names(message: Message) -> Collection[str]:
    """After a heartbeat: the states that every robot may have. After its capabilities: what they name of its own.

    Only names without characters on which a broker might close the connection: anybody may publish capabilities.
    """
    base, slash, metric = message.topic.partition(f"/{OUTGOING}/")
    suffix = f"{OUTGOING}/{metric}"
    if not slash or len(base) > _LONGEST:
        return ()
    if suffix in _HEARTBEATS and not message.retain:
        return [channel.topic(base) for channel in _STATES]
    if suffix != CAPABILITIES.suffix:
        return ()
    own = re.compile(rb'"(%s/[\w./-]{1,%d})"' % (re.escape(f"{base}/{OUTGOING}".encode()), _LONGEST))
    return list(dict.fromkeys(name.decode() for name in own.findall(message.payload)))[:_MOST]
