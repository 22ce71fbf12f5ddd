"""The rules of a Zenoh hub, from the same table as a broker's: the rights of each account in a certificate."""

from collections.abc import Iterable, Iterator, Sequence

from pebble.contract import CHANNELS, ESTOP, INCOMING, OUTGOING, Kind
from pebble.contract.names import with_name
from pebble.extensions.fleet.folder import Fleet
from pebble.extensions.fleet.hub_access import (
    EVERYTHING,
    IN,
    OUT,
    Access,
    Grant,
    HubAccount,
    access_control,
    priorities,
    written,
)
from pebble.extensions.fleet.roles import Account, ProgramRole, Rule
from pebble.transports.zenoh import wire
from pebble.transports.zenoh.keymap import filter_to_key

_ANY = "+/+/+"  # the levels of any robot
_STOP = ESTOP.topic(_ANY)
_FLAGS = tuple(f"/{channel.suffix}" for channel in CHANNELS if channel.kind is Kind.FLAG)


def zenoh_text(fleet: Fleet) -> bytes:
    """Return the file that a hub reads as ``transport.access``."""
    rules = {name: fleet.rules_of(name, at_hub=True) for name in fleet.accounts}
    hub_accounts = {name: _hub_account(fleet.accounts[name], its_rules) for name, its_rules in rules.items()}
    grants = (  # rows of access_control: names in certificates, and what these may do
        ([name], _grants(name, rules[name], hub_accounts[name].retains, is_hub=ProgramRole.HUB in account.roles))
        for name, account in fleet.accounts.items()
    )
    commands, stops = _keys([f"{_ANY}/{INCOMING}/#"]), _keys((_STOP, with_name(_STOP, "+")))
    return written(Access(access_control(grants), hub_accounts, priorities(commands, stops)))


def _hub_account(account: Account, held: Iterable[Rule]) -> HubAccount:
    """Return an account's filters for wills and retained messages.

    A robot may retain all that it may publish, and leave a will on its outgoing topics. Others may retain flags.
    """
    writes = [rule.filter for rule in held if rule.access == "write"]
    is_robot = ProgramRole.ROBOT in account.roles
    wills = [f"{base}/{OUTGOING}/#" for base in account.bases if is_robot]
    all_topics = [filter_ for filter_ in writes if is_robot and filter_.endswith("/#")]  # a robot's rule: {base}/#
    flags = [filter_ for filter_ in writes if filter_.endswith(_FLAGS)]  # not those that end with an account's name
    return HubAccount(tuple(wills), tuple(dict.fromkeys((*wills, *all_topics, *flags))))


def _grants(name: str, held: Sequence[Rule], retains: Iterable[str], *, is_hub: bool) -> Iterator[Grant]:
    """Yield the grants that an account's client needs. It cannot act as a hub, or answer queries of others.

    ``held``: the account's rules; ``retains``: filters of the topics that it may retain.
    """
    if is_hub:
        yield from EVERYTHING
        return
    reads, writes = (_keys(rule.filter for rule in held if rule.access == access) for access in ("read", "write"))
    # What ``wire`` adds to messages: the client's hello and goodbye, retained messages and their numbers, running hubs.
    greetings = tuple(wire.asked(kind, name) for kind in (wire.HELLO, wire.BYE))
    retained, retained_counts, running_hubs = _retained(reads), (f"{wire.SYNC}*",), (f"{wire.UP}*",)
    yield Grant(OUT, ("put",), reads)  # OUT: from the hub to the client
    yield Grant(IN, ("declare_subscriber",), reads)
    yield Grant(IN, ("put",), (*writes, *_retained(_keys(retains))))
    # Zenoh lets a declaration out only if a rule covers its whole key; programs on the hub's machine may declare any.
    yield Grant(OUT, ("declare_subscriber",), ("**", f"{wire.RETAINED}**"))
    for keys in (retained, greetings, retained_counts):
        yield Grant(IN, ("query",), keys)
        yield Grant(OUT, ("reply", "declare_queryable"), keys)
    yield Grant(IN, ("liveliness_token",), (f"{wire.LIVE}{name}{wire.OF}$*",))
    yield Grant(IN, ("liveliness_query", "declare_liveliness_subscriber"), running_hubs)
    yield Grant(OUT, ("liveliness_token",), running_hubs)


def _retained(keys: Iterable[str]) -> tuple[str, ...]:
    return tuple(wire.RETAINED + key for key in keys)


def _keys(filters: Iterable[str]) -> tuple[str, ...]:
    return tuple(map(filter_to_key, filters))
