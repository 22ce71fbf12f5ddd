"""mosquitto's dynamic-security plugin: the commands that change its accounts while it runs, and what it has."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from pebble.fleet.broker_client import BrokerClient, Place
from pebble.fleet.broker_files import acls, default_access, role_of
from pebble.fleet.folder import Fleet, FleetError
from pebble.fleet.roles import CONTROL_ANSWERS, CONTROL_TOPIC

_PAGE = 50  # accounts of one answer: it stays below the longest packet that is read
_BATCH = 100  # commands of one message

Command = dict[str, Any]


def changes(before: Fleet, after: Fleet, passwords: Mapping[str, str]) -> Iterator[Command]:
    """What turns a broker of ``before`` into one of ``after``. ``passwords``: those that are new, by account.

    Who goes, goes first. An account with a new password is made anew, whatever the broker has of it.
    """
    for name in before.accounts:
        if name not in after.accounts:
            yield from _removal(name)
    for name in after.accounts:
        if name in passwords:
            yield from _removal(name)
            yield {"command": "createRole", "rolename": role_of(name), "acls": acls(after.rules_of(name))}
            roles = [{"rolename": role_of(name)}]
            yield {"command": "createClient", "username": name, "password": passwords[name], "roles": roles}
        elif after.rules_of(name) != before.rules_of(name):
            yield {"command": "modifyRole", "rolename": role_of(name), "acls": acls(after.rules_of(name))}


def repairs(fleet: Fleet, control: "Control") -> Iterator[Command]:
    """What leaves a broker with the accounts of the fleet and the rules of the table; it cannot make lost accounts."""
    yield {"command": "setDefaultACLAccess", "acls": default_access()}
    groups = set(control.ask("listGroups").get("groups", ())) - {control.anonymous_group()}  # whose end is mosquitto's
    yield from ({"command": "deleteGroup", "groupname": name} for name in sorted(groups))
    for client in control.accounts():
        name = client["username"]
        if name not in fleet.accounts:
            yield {"command": "deleteClient", "username": name}
        elif client.get("disabled"):
            yield {"command": "enableClient", "username": name}
    names = {role_of(name): name for name in fleet.accounts}
    for role in control.roles():
        if role["rolename"] in names:
            held = acls(fleet.rules_of(names[role["rolename"]]))
            yield {"command": "modifyRole", "rolename": role["rolename"], "acls": held}
        else:
            yield {"command": "deleteRole", "rolename": role["rolename"]}


def _removal(name: str) -> Iterator[Command]:
    yield {"command": "deleteClient", "username": name}
    yield {"command": "deleteRole", "rolename": role_of(name)}


class Control:
    """A connection that may change accounts. Raises FleetError for what the broker refuses."""

    def __init__(self, place: Place, username: str, password: str) -> None:
        self._client = BrokerClient(place, username, password)
        self._client.subscribe([CONTROL_ANSWERS])

    def __enter__(self) -> "Control":
        return self

    def __exit__(self, *_: object) -> None:
        self._client.__exit__()

    def send(self, commands: Iterable[Command]) -> None:
        """All of them, in batches; each batch acts at once."""
        waiting = list(commands)
        for at in range(0, len(waiting), _BATCH):
            self._batch(waiting[at : at + _BATCH])

    def accounts(self) -> list[dict[str, Any]]:
        """What the broker has: user names, their roles, whether they are disabled."""
        return list(self._pages("listClients", "clients"))

    def roles(self) -> list[dict[str, Any]]:
        return list(self._pages("listRoles", "roles"))

    def ask(self, command: str) -> dict[str, Any]:
        """The data of one answer."""
        return dict(self._batch([{"command": command}])[0].get("data") or {})

    def anonymous_group(self) -> str:
        """The group of clients without a name; empty if there is none."""
        return str(self.ask("getAnonymousGroup").get("group", {}).get("groupname", ""))

    def _pages(self, command: str, key: str) -> Iterator[dict[str, Any]]:
        offset = 0
        while True:
            asked = {"command": command, "verbose": True, "count": _PAGE, "offset": offset}
            found = self._batch([asked])[0]["data"][key]
            yield from found
            if len(found) < _PAGE:
                return
            offset += _PAGE

    def _batch(self, commands: Sequence[Command]) -> list[dict[str, Any]]:
        received = self._client.received
        received.clear()
        self._client.publish(CONTROL_TOPIC, json.dumps({"commands": commands}).encode())
        self._client.wait(lambda: bool(received), "change its accounts: has it the dynamic-security plugin?")
        try:
            responses: list[dict[str, Any]] = json.loads(received[-1][1])["responses"]
        except (ValueError, KeyError, TypeError):
            raise FleetError("the broker's plugin answers in an unknown form") from None
        for response in responses:
            command, error = str(response.get("command")), response.get("error")
            if error and not command.startswith("delete"):  # what is to be gone may be gone
                raise FleetError(f"the broker refuses {command}: {error}")
        return responses
