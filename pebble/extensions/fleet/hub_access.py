"""Rights of connections from other machines at a hub, by the name in their certificate: Zenoh's access_control.

The hub itself refuses what Zenoh cannot: wills, and what is retained, of accounts that it is not for.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec.structs import replace

from pebble.errors import TransportError
from pebble.transports.renewed import Renewed
from pebble.transports.topics import matches
from pebble.transports.zenoh import wire
from pebble.transports.zenoh.hub.admission import Admission
from pebble.transports.zenoh.keymap import key_to_topic
from pebble.transports.zenoh.session import ALL_MESSAGES, LOCAL, OTHER_MACHINES

IN, OUT = ("ingress",), ("egress",)  # as the hub sees it
_COMMANDS = {"priority": "interactive_high", "congestion_control": "drop"}
_STOPS = {"priority": "real_time", "congestion_control": "block"}
_FIELDS = ("flows", "messages", "key_exprs")


class Grant(NamedTuple):
    """Messages that may pass, by their keys."""

    flows: tuple[str, ...]
    messages: tuple[str, ...]
    keys: tuple[str, ...]


EVERYTHING = (Grant((*IN, *OUT), ALL_MESSAGES, wire.ALL_KEYS),)


class HubAccount(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Topics, as filters: those on which the account may leave a will, and those that it may retain."""

    wills: tuple[str, ...] = ()
    retains: tuple[str, ...] = ()


class _Metadata(msgspec.Struct, frozen=True):
    pebble: dict[str, HubAccount]


class _File(msgspec.Struct, frozen=True):
    """The access file. It is a configuration of Zenoh, too, which lets others use its ``metadata``."""

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
        content = msgspec.json.decode(file.read_bytes(), type=_File)
    except OSError as error:
        raise TransportError(f"transport.access: {file}: {error.strerror}; `pebble fleet zenoh` makes it") from None
    except msgspec.MsgspecError as error:
        raise TransportError(f"transport.access: {file}: {error}; `pebble fleet zenoh` makes it") from None
    if content.access_control.get("enabled") is not True or content.access_control.get("default_permission") != "deny":
        raise TransportError(f"transport.access: {file} lets everybody in; `pebble fleet zenoh` makes it anew")
    return Access(content.access_control, content.metadata.pebble, content.qos)


def written(access: Access) -> bytes:
    """Return ``access`` as a file."""
    text = msgspec.json.encode(_File(dict(access.control), _Metadata(dict(access.accounts)), dict(access.qos)))
    return msgspec.json.format(text, indent=1) + b"\n"


def access_control(rows: Iterable[tuple[Sequence[str], Iterable[Grant]]]) -> dict[str, Any]:
    """Let connections of this machine do everything, and those with a certificate what the row of their name grants.

    Equal grants become one rule, because Zenoh reads 1 MB a second. It does not refuse the others, but drops all that
    they send, and sends them nothing. It reads this once.
    """
    rules: dict[Grant, dict[str, Any]] = {}
    subjects: list[Mapping[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for subject, grants in [(LOCAL, EVERYTHING), *((_named(names), grants) for names, grants in rows if names)]:
        granted = [rules.setdefault(grant, _rule(len(rules), grant)) for grant in grants if grant.keys]
        subjects.append(subject)
        policies.append({"rules": [rule["id"] for rule in granted], "subjects": [subject["id"]]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": list(rules.values()),
        "subjects": subjects,
        "policies": policies,
    }


def first(commands: Sequence[str], stops: Sequence[str]) -> dict[str, Any]:
    """Return Zenoh's qos: of what other machines send, ``stops`` alone have the first priority, and wait.

    Else a sender chooses: with that priority it would hold up the stops of others, and with what waits for room it
    would have the hub close the connection of a receiver that reads slower than it sends. Both are keys; stops are
    commands.
    """
    rows = (("commands", commands, _COMMANDS), ("stops", stops, _STOPS))
    fields = {"messages": ["put"], "flows": [*IN], "link_protocols": OTHER_MACHINES}
    network = [{"id": name, "key_exprs": [*keys], "overwrite": changes, **fields} for name, keys, changes in rows]
    return {"network": network}


def _rule(number: int, grant: Grant) -> dict[str, Any]:
    return {"id": f"r{number}", "permission": "allow", **dict(zip(_FIELDS, grant, strict=True))}


def _named(names: Sequence[str]) -> dict[str, Any]:
    return {"id": names[0], "link_protocols": OTHER_MACHINES, "cert_common_names": list(names)}


class AccountAdmission(Admission):
    """The admission of clients at a hub, also of accounts of other machines, by the access file."""

    def __init__(self, file: Path, wills: Sequence[tuple[str, bool]], unretained: Sequence[str] = ()) -> None:
        super().__init__(wills, unretained)
        self._access = Renewed([file], lambda: read_access(file))
        self.accounts: Mapping[str, HubAccount] = {}

    def newest(self) -> Access:
        return self._access.get()

    def rules(self) -> Mapping[str, Any]:
        control, self.accounts, qos = self._access.get()
        return {"access_control": control, "qos": qos}

    def hello(self, account: str, hello: wire.Hello) -> wire.Hello | None:
        """Return ``hello`` without what this account may not; None: it is not answered.

        Its certificate allows an account to ask under its own name only.
        """
        if not account:
            return hello
        known = self.accounts.get(account)
        if known is None or not self.owns(account, hello.name):
            self.log(account, "hello", "its session must be named after an account that is known")
            return None
        offered = hello.own if known.retains else {}
        own = {key: digest for key, digest in offered.items() if _any(known.retains, key_to_topic(key))}
        return replace(hello, will=self._of_account(account, known, hello.will), own=own)

    def owns(self, account: str, session: str) -> bool:
        return not account or session.startswith(account + wire.OF)

    def _of_account(self, account: str, known: HubAccount, will: wire.Will | None) -> wire.Will | None:
        if will is None:
            return None
        will = replace(will, client=f"{account}{wire.OF}{will.client}")  # so that it is no one else's predecessor
        if _any(known.wills, will.topic):
            return will
        self.refuse_will(will, "an account leaves a will for its own robot only")
        return None


def _any(filters: Sequence[str], topic: str) -> bool:
    return any(matches(filter_, topic) for filter_ in filters)
