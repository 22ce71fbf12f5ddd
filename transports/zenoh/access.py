"""What connections from other machines may do at a hub, by the name in their certificate: Zenoh's access_control."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from pebble.errors import TransportError
from pebble.transports.zenoh import wire

_MESSAGES = (
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "reply",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)
IN, OUT = ("ingress",), ("egress",)  # as the hub sees it
_OTHER_MACHINES = ["tls", "quic"]  # the protocols by which they connect
_COMMANDS = {"priority": "interactive_high", "congestion_control": "drop"}
_STOPS = {"priority": "real_time", "congestion_control": "block"}
_FIELDS = ("flows", "messages", "key_exprs")


class Grant(NamedTuple):
    """Messages that may pass, by their keys."""

    flows: tuple[str, ...]
    messages: tuple[str, ...]
    keys: tuple[str, ...]


EVERYTHING = (Grant((*IN, *OUT), _MESSAGES, wire.ALL_KEYS),)


class HubAccount(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Topics, as filters: those on which the account may leave a will, and those that it may retain."""

    wills: tuple[str, ...] = ()
    retains: tuple[str, ...] = ()


class _Metadata(msgspec.Struct, frozen=True):
    pebble: dict[str, HubAccount]


class _File(msgspec.Struct, frozen=True):
    """Also a configuration of Zenoh, which lets others keep what they like in its ``metadata``."""

    access_control: dict[str, Any]
    metadata: _Metadata
    qos: dict[str, Any] = {}


class Access(NamedTuple):
    """The rules, the accounts by their names, which are those in certificates, and what goes first: `first`."""

    control: Mapping[str, Any]
    accounts: Mapping[str, HubAccount]
    qos: Mapping[str, Any] = {}  # none in a file that was written before there were any


def read_access(file: Path) -> Access:
    """Read what ``pebble fleet zenoh`` wrote. Raises TransportError."""
    try:
        found = msgspec.json.decode(file.read_bytes(), type=_File)
    except OSError as error:
        raise TransportError(f"transport.access: {file}: {error.strerror}; `pebble fleet zenoh` makes it") from None
    except msgspec.MsgspecError as error:
        raise TransportError(f"transport.access: {file}: {error}; `pebble fleet zenoh` makes it") from None
    if found.access_control.get("enabled") is not True or found.access_control.get("default_permission") != "deny":
        raise TransportError(f"transport.access: {file} lets everybody in; `pebble fleet zenoh` makes it anew")
    return Access(found.access_control, found.metadata.pebble, found.qos)


def written(access: Access) -> bytes:
    """``access`` as a file."""
    text = msgspec.json.encode(_File(dict(access.control), _Metadata(dict(access.accounts)), dict(access.qos)))
    return msgspec.json.format(text, indent=1) + b"\n"


def access_control(rows: Iterable[tuple[Sequence[str], Iterable[Grant]]]) -> dict[str, Any]:
    """Let connections of this machine do everything, and those with a certificate what the row of their name grants.

    Equal grants become one rule, because Zenoh reads 1 MB a second. It does not refuse the others, but drops all that
    they send, and sends them nothing. It reads this once.
    """
    local = {"id": "this machine", "link_protocols": ["unixsock-stream", "tcp"]}
    rules: dict[Grant, dict[str, Any]] = {}
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for subject, grants in [(local, EVERYTHING), *((_named(names), grants) for names, grants in rows if names)]:
        own = [rules.setdefault(grant, _rule(len(rules), grant)) for grant in grants if grant.keys]
        subjects.append(subject)
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [subject["id"]]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": list(rules.values()),
        "subjects": subjects,
        "policies": policies,
    }


def first(commands: Sequence[str], stops: Sequence[str]) -> dict[str, Any]:
    """Zenoh's qos: of what connections from other machines send, ``stops`` alone have the first priority, and wait.

    Else a sender chooses: with that priority it would hold up the stops of others, and with what waits for room it
    would have the hub close the connection of a receiver that reads slower than it sends. Both are keys; stops are
    commands.
    """
    rows = (("commands", commands, _COMMANDS), ("stops", stops, _STOPS))
    here = {"messages": ["put"], "flows": [*IN], "link_protocols": _OTHER_MACHINES}
    network = [{"id": name, "key_exprs": [*keys], "overwrite": changes, **here} for name, keys, changes in rows]
    return {"network": network}


def _rule(number: int, grant: Grant) -> dict[str, Any]:
    return {"id": f"r{number}", "permission": "allow", **dict(zip(_FIELDS, grant, strict=True))}


def _named(names: Sequence[str]) -> dict[str, Any]:
    return {"id": names[0], "link_protocols": _OTHER_MACHINES, "cert_common_names": list(names)}
