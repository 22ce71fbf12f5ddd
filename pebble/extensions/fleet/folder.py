"""The folder of a broker's fleet, with `fleet.json`: the accounts and their roles. It holds no secrets."""

import logging
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace

from pebble.config import hosts
from pebble.contract.identity import SERVERS, Identity
from pebble.contract.names import NAME
from pebble.errors import ConfigError, PebbleError
from pebble.extensions.fleet.roles import GATEWAYS, Account, Extra, ProgramRole, Right, Rule, conflict, covered, rules
from pebble.ownership import read_plain
from pebble.runtime.whole_file import write

log = logging.getLogger(__name__)

FLEET, CONF, PID, ACL, PASSWORDS = "fleet.json", "mosquitto.conf", "mosquitto.pid", "acl", "passwords"
ZENOH = "zenoh.json"
PORT, PLAIN_PORT = 8883, 1883  # of MQTT over TLS, and without
MAX_ACCOUNTS = 10_000  # of one fleet
_LOCK = ".lock"
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)  # which Windows lacks
_METRIC = re.compile(r"[^/#$+\x00-\x20\x7f]+|\+")  # one level


class FleetError(PebbleError):
    """An error: an account, a folder or a broker cannot be used. Example: ``hall/fleet.json has no account 'ann'``."""


class Server(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """The place where a broker of the fleet listens. ``unencrypted``: a port for boards without TLS.

    ``included``: it is the mosquitto of its machine, which includes `mosquitto.conf` in its own configuration. Programs
    there reach it at ``PLAIN_PORT`` of loopback, without TLS, which would keep out a robot whose clock is not set.
    """

    host: str
    port: Annotated[int, Meta(ge=1, le=65535)] = PORT
    unencrypted: Annotated[int, Meta(ge=1, le=65535)] | None = None
    included: bool = False


class Fleet(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The content of `fleet.json`. The first broker is the one whose files are in this folder.

    ``rules``: `plugin` if an earlier version made the fleet for mosquitto's dynamic-security plugin; `pebble fleet
    apply` turns it into files. ``plain``: robots read topics without account names as well as topics with them.
    ``hubs``: the place of the Zenoh hubs that read the rules.
    """

    level: Literal["login", "named"]
    brokers: Annotated[tuple[Server, ...], Meta(min_length=1)]
    rules: Literal["plugin", "files"] = "files"
    plain: bool = False
    hubs: Literal["none", "here", "elsewhere"] = "none"
    accounts: dict[str, Account] = msgspec.field(default_factory=dict)
    extra: Extra = Extra()

    def rules_of(self, name: str, *, at_hub: bool = False) -> tuple[Rule, ...]:
        account = self.accounts[name]
        return rules(name, account, self.level, plain=self._plain_bases(), extra=self.extra, at_hub=at_hub)

    def with_account(self, name: str, account: Account) -> "Fleet":
        return replace(self, accounts={**self.accounts, name: account})

    def without(self, name: str) -> "Fleet":
        return replace(self, accounts={other: account for other, account in self.accounts.items() if other != name})

    def _plain_bases(self) -> Sequence[str]:
        if self.plain:
            return ("+/+/+",)
        return tuple(base for account in self.accounts.values() if account.plain for base in account.bases)


def load(folder: Path) -> Fleet:
    """Return the fleet of a folder. Raises FleetError with the mistake in it."""
    file = folder / FLEET
    try:
        fleet = msgspec.json.decode(read_plain(file), type=Fleet)
    except FileNotFoundError:
        raise FleetError(f"there is no {file}: `pebble fleet init {folder} --host NAME` makes a fleet") from None
    except OSError as error:
        raise FleetError(f"{file}: {error.strerror}") from None
    except msgspec.MsgspecError as error:
        raise FleetError(f"{file}: {error}") from None
    for server in fleet.brokers:
        try:
            hosts.host(server.host)
        except hosts.HostError as error:
            raise FleetError(f"{file}: brokers: a host {error}") from None
    if len(fleet.accounts) > MAX_ACCOUNTS:
        raise FleetError(f"{file}: {len(fleet.accounts)} accounts; a broker's files have {MAX_ACCOUNTS} at most")
    for name, account in fleet.accounts.items():
        if why := refused(fleet.without(name), name, account):
            raise FleetError(f"{file}: accounts.{name}: {why}")
    for right in (Right.LOOK, Right.DRIVE, Right.SYSTEM):
        for metric in getattr(fleet.extra, right):
            if not all(map(_METRIC.fullmatch, metric.split("/"))) or metric.startswith(("by/", "estop")):
                raise FleetError(f"{file}: extra: {metric!r} is no metric: write what follows incoming/, such as arm/+")
            if other := covered(right, metric):
                raise FleetError(f"{file}: extra.{right}: {metric!r} covers {other} as well: write a narrower one")
    return fleet


def save(folder: Path, fleet: Fleet) -> None:
    """Replace `fleet.json` in one step. Raises FleetError."""
    text = msgspec.json.format(msgspec.json.encode(fleet), indent=2) + b"\n"
    write(folder / FLEET, text, 0o644, FleetError)


def refused(fleet: Fleet, name: str, account: Account) -> str:
    """Return why this account cannot be added; empty if it can."""
    if not NAME.fullmatch(name):
        return f"{name!r} is no name: use 1 to 32 of a-z, 0-9, _ and -"
    if name in fleet.accounts:
        return f"{name} exists already, as {', '.join(fleet.accounts[name].roles)}"
    if why := conflict(account.roles):
        return why
    is_gateway = any(role in account.roles for role in (ProgramRole.GATEWAY, ProgramRole.BOARDS))
    is_robot = any(role in account.roles for role in (ProgramRole.ROBOT, ProgramRole.NEIGHBOUR))
    bases_needed = 1 if is_robot else 0
    if not is_gateway and len(account.bases) != bases_needed:
        return "a robot, or a neighbour, has one base (--base pebble/robots/goob), and no other account has any"
    if account.plain and not is_robot:
        return "only a robot can be plain"
    if account.people and ProgramRole.PAGE not in account.roles:
        return "only a page has people of its own"
    for base in account.bases:
        if why := _refused_base(base, may_be_filter=is_gateway):
            return why
        for owner, other in fleet.accounts.items():
            if is_robot and base in other.bases and other.roles == account.roles:
                return f"{base} belongs to {owner}"
    return ""


def _refused_base(base: str, *, may_be_filter: bool) -> str:
    """Return why this base cannot be used; empty if it can. ``may_be_filter``: its levels may be ``+``."""
    levels = base.split("/")
    try:
        Identity(*("any" if level == "+" and may_be_filter else level for level in levels))
    except (ConfigError, TypeError):
        return f"{base!r} is no base: write SYSTEM/TYPE/ID, such as pebble/robots/goob"
    if any(character.isspace() or character == "%" for character in base):
        return f"{base!r} has a blank or %, which the rules of a broker cannot have"
    if levels[1] in (SERVERS, GATEWAYS):
        return f"{base!r} is no robot's base: {levels[1]} are no robots"
    return ""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder's lock: only one command at a time changes it. Raises FleetError if there is no folder."""
    try:
        descriptor = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | _NO_LINK, 0o600)
    except OSError as error:
        raise FleetError(f"{folder}: {error.strerror}") from None
    try:
        import fcntl  # Windows has none: there only what changes a fleet fails

        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                log.error(
                    "another command changes %s, and is waited for: `fuser -v %s` names it", folder, folder / _LOCK
                )
                fcntl.flock(descriptor, fcntl.LOCK_EX)
        except OSError as error:
            log.error("%s cannot be locked (%s): let no other command change it meanwhile", folder, error.strerror)
        yield
    finally:
        os.close(descriptor)
