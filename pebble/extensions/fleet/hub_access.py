"""Rights of other machines at a hub, by the name in their certificate, enforced by Zenoh's access_control.

Zenoh has no rules for wills and retained messages; the hub itself refuses those.
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


class Grant(NamedTuple):
    """A permission for the messages of some keys."""

    flows: tuple[str, ...]
    messages: tuple[str, ...]
    keys: tuple[str, ...]


EVERYTHING = (Grant((*IN, *OUT), ALL_MESSAGES, wire.ALL_KEYS),)


class HubAccount(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An account's topic filters at a hub: where it may leave a will, and which messages it may retain."""

    wills: tuple[str, ...] = ()
    retains: tuple[str, ...] = ()


class _Metadata(msgspec.Struct, frozen=True):
    pebble: dict[str, HubAccount]


class _File(msgspec.Struct, frozen=True):
    """The access file. It is a configuration of Zenoh, whose ``metadata`` is free for others."""

    access_control: dict[str, Any]
    metadata: _Metadata
    qos: dict[str, Any] = {}


class Access(NamedTuple):
    """The content of the access file: rules, accounts by their certificate's name, and :func:`priorities`."""

    control: Mapping[str, Any]
    accounts: Mapping[str, HubAccount]
    qos: Mapping[str, Any] = {}  # none in a file that was written before there were any


def read_access(file: Path) -> Access:
    """Read the access file, as ``pebble fleet zenoh`` writes it. Raises TransportError."""
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
    """Return the bytes of the access file."""
    text = msgspec.json.encode(_File(dict(access.control), _Metadata(dict(access.accounts)), dict(access.qos)))
    return msgspec.json.format(text, indent=1) + b"\n"


def access_control(rows: Iterable[tuple[Sequence[str], Iterable[Grant]]]) -> dict[str, Any]:
    """Return Zenoh's access_control: this machine may do everything, an account what its row grants.

    Equal grants become one rule, because Zenoh reads only 1 MB a second at its start. An account without a row is not
    disconnected: Zenoh drops its messages and sends it none.
    """
    rules: dict[Grant, dict[str, Any]] = {}
    subjects: list[Mapping[str, Any]] = []
    policies: list[dict[str, Any]] = []
    accounts = [(_named(names), grants) for names, grants in rows if names]
    for subject, grants in [(LOCAL, EVERYTHING), *accounts]:
        granted = [rules.setdefault(grant, _rule(f"r{len(rules)}", grant)) for grant in grants if grant.keys]
        subjects.append(subject)
        policies.append({"rules": [rule["id"] for rule in granted], "subjects": [subject["id"]]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": list(rules.values()),
        "subjects": subjects,
        "policies": policies,
    }


def priorities(commands: Sequence[str], stops: Sequence[str]) -> dict[str, Any]:
    """Return Zenoh's setting ``qos`` for messages from other machines, by Zenoh's keys; ``commands`` include ``stops``.

    Only ``stops`` get the first priority, and only they wait for a slow receiver; other commands are dropped. Otherwise
    the sender would choose: commands with the first priority would delay stops, and messages that wait would make the
    hub disconnect a slow receiver.
    """
    rows = (("commands", commands, _COMMANDS), ("stops", stops, _STOPS))
    fields = {"messages": ["put"], "flows": [*IN], "link_protocols": OTHER_MACHINES}
    network = [{"id": name, "key_exprs": [*keys], "overwrite": changes, **fields} for name, keys, changes in rows]
    return {"network": network}


def _rule(name: str, grant: Grant) -> dict[str, Any]:
    allowed = {"flows": grant.flows, "messages": grant.messages, "key_exprs": grant.keys}
    return {"id": name, "permission": "allow", **allowed}


def _named(names: Sequence[str]) -> dict[str, Any]:
    return {"id": names[0], "link_protocols": OTHER_MACHINES, "cert_common_names": list(names)}


class AccountAdmission(Admission):
    """The hub's rules for clients, including accounts of other machines, from the access file."""

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
        """Return ``hello`` reduced to what the account may do; None if it gets no answer.

        An account may use only session names that begin with its own name.
        """
        if not account:
            return hello
        rules = self.accounts.get(account)
        if rules is None or not self.owns(account, hello.name):
            self.log(account, "hello", "its session must be named after an account that is known")
            return None
        offered = hello.own if rules.retains else {}
        allowed = {key: digest for key, digest in offered.items() if _any(rules.retains, key_to_topic(key))}
        return replace(hello, will=self._allowed_will(account, rules, hello.will), own=allowed)

    def owns(self, account: str, session: str) -> bool:
        return not account or session.startswith(account + wire.OF)

    def _allowed_will(self, account: str, rules: HubAccount, will: wire.Will | None) -> wire.Will | None:
        """Return a client's will, named after its account; None if it has none, or if the account may not leave it."""
        if will is None:
            return None
        will = replace(will, client=f"{account}{wire.OF}{will.client}")  # so it replaces no other account's will
        if _any(rules.wills, will.topic):
            return will
        self.refuse_will(will, "an account leaves a will for its own robot only")
        return None


def _any(filters: Sequence[str], topic: str) -> bool:
    """True if one of the filters matches the topic."""
    return any(matches(filter_, topic) for filter_ in filters)
