"""The table of roles and the rights of each.

The rules of brokers, the rights of people on the operator page, and the tables of docs/ext/fleet.md are made from it.
A robot uses ``WRITES``, the commands that each right permits, for commands without an account.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from msgspec import Struct

from pebble.config.security import SecurityLevel
from pebble.contract import INCOMING, OUTGOING, Channel, Kind
from pebble.contract import channels as c
from pebble.contract.identity import GATEWAYS as GATEWAYS
from pebble.contract.identity import SERVERS
from pebble.contract.names import BY

_ANY = "+/+/+"  # any component


class Right(StrEnum):
    """A right on a robot, or at the page."""

    LOOK = "look"
    STOP = "stop"
    DRIVE = "drive"
    RESET = "reset"
    TAKE = "take"
    SYSTEM = "system"
    EXPAND = "expand"
    PEOPLE = "people"


#: The commands that a right allows: channels of the contract, or metrics below ``incoming/``.
WRITES: Mapping[Right, tuple[Channel | str, ...]] = {
    Right.LOOK: (c.VIDEO_CONTROL,),
    Right.STOP: (c.ESTOP,),
    Right.DRIVE: (
        c.DRIVE,
        c.GROUP,  # all that may be in it is in this right
        c.CONTROL,
        c.LIGHTS_SOLID,
        c.LIGHTS_FLASH,
        c.AUDIO_CONTROL,
        c.AUDIO_STREAM,
        c.SOUNDBOARD_COMMAND,
        c.AUTONOMY_COMMAND,
        c.MCU_COMMAND,
        c.OUTLET_COMMAND,
        c.MIP_RAW,
        c.MQTT_AUDIO,
        c.MQTT_VIDEO,
    ),
    Right.RESET: (c.ESTOP_RESET,),
    Right.TAKE: (c.CONTROL_TAKE,),
    Right.SYSTEM: (c.REBOOT, c.SERVICE_RESTART, c.GIT_PULL, c.REMOTE_MIRROR),
    Right.EXPAND: (c.EXPANDER,),  # who may not publish streams must not say so: a robot would send none by themselves
}


class Role(StrEnum):
    """A role of a person."""

    VIEWER = "viewer"
    DRIVER = "driver"
    MAINTAINER = "maintainer"
    SAFETY = "safety"
    ADMIN = "admin"


class ProgramRole(StrEnum):
    """A role of a program that has its own account."""

    PAGE = "page"  # a server of the operator page, which asks the rights of its own people
    ROBOT = "robot"
    NEIGHBOUR = "neighbour"  # what a robot is to the other robots at the hub of a LAN
    GATEWAY = "gateway"
    BOARDS = "boards"  # a gateway at the broker of a LAN, where the robots are that it carries
    HUB = "hub"  # a Zenoh hub or router, which carries what all accounts send
    EXPANDER = "expander"  # beside a broker: `pebble topic expand`, or a page server with `expand`


_EVERYBODY = frozenset({Right.LOOK, Right.STOP})
_DRIVING = _EVERYBODY | {Right.DRIVE}
_RIGHTS: Mapping[str, frozenset[Right]] = {
    Role.VIEWER: _EVERYBODY,
    Role.DRIVER: _DRIVING,
    Role.MAINTAINER: _DRIVING | {Right.TAKE, Right.SYSTEM},
    Role.SAFETY: _DRIVING | {Right.RESET, Right.TAKE},
    Role.ADMIN: frozenset(Right) - {Right.EXPAND},
    ProgramRole.PAGE: frozenset(Right) - {Right.PEOPLE, Right.EXPAND},
    ProgramRole.NEIGHBOUR: frozenset(),
    ProgramRole.ROBOT: frozenset(),  # robots and gateways have the topics of their own bases
    ProgramRole.GATEWAY: frozenset(),
    ProgramRole.BOARDS: frozenset(),
    ProgramRole.HUB: frozenset(),  # at a broker; at a hub everything
    ProgramRole.EXPANDER: frozenset({Right.EXPAND}),
}
ROLES = tuple(_RIGHTS)
_ALONE = frozenset(ProgramRole)  # roles that go with no other one, but for these two:
_GO_TOGETHER = {ProgramRole.PAGE, ProgramRole.EXPANDER}


class Rule(NamedTuple):
    """A permission of an account at a broker. ``access``: ``read`` or ``write``."""

    access: str
    filter: str


class Account(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """An account in `fleet.json`. ``bases``: its own base topic, or those that a gateway carries.

    ``plain``: a robot that does not know account names, so the topics of its commands have none. ``people``: the
    database of a page server's people, if it is on this machine.
    """

    roles: tuple[str, ...]
    bases: tuple[str, ...] = ()
    plain: bool = False
    people: str = ""


class Extra(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Metrics beyond the contract, by the right that may write them: ``{"drive": ["arm/+"]}``."""

    look: tuple[str, ...] = ()
    drive: tuple[str, ...] = ()
    system: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Session:
    """A login. ``id`` identifies it in the audit, and cannot be used to log in."""

    id: str
    user: str
    role: Role


#: The login of a browser on the same machine where there is no login.
LOCAL = Session("local", "local", Role.ADMIN)


def rights(roles: Iterable[str], level: SecurityLevel) -> frozenset[Right]:
    """Return the rights of a person with these roles together.

    Below the level ``named``, those who may drive may also reset.
    """
    held = frozenset[Right]().union(*(_RIGHTS[role] for role in roles))
    return held | {Right.RESET} if level != "named" and Right.DRIVE in held else held


def page_rights(role: Role, level: SecurityLevel = "open") -> frozenset[str]:
    """Return the rights of a person on the operator page beyond those of everybody."""
    return frozenset(right.value for right in rights((role,), level) - _EVERYBODY)


def right_of(channel: Channel) -> str:
    """Return the right that is needed to write this channel."""
    return next(right.value for right, channels in WRITES.items() if channel in channels)


def conflict(roles: Sequence[str]) -> str:
    """Return why these roles cannot be combined in one account; empty if they can."""
    for role in roles or ("",):  # an account without roles is refused as one with the role ""
        if role not in _RIGHTS:
            return f"{role!r} is no role: use {', '.join(Role)}, or for programs {', '.join(ProgramRole)}"
    if len(set(roles)) == 1 or set(roles) == _GO_TOGETHER:
        return ""
    alone = [role for role in roles if role in _ALONE]
    return f"{alone[0]} goes with no other role" if alone else ""


def rules(
    name: str,
    account: Account,
    level: SecurityLevel,
    *,
    plain: Sequence[str] = (),
    extra: Extra | None = None,
    at_hub: bool = False,
) -> tuple[Rule, ...]:
    """Return all rules of this account at a broker.

    ``plain``: bases of robots that do not know account names, or ``+/+/+``. ``extra``: metrics beyond the contract.
    ``at_hub``: return the rules at a Zenoh hub. They differ for a gateway, whose robots are at the hub and their
    operators at the broker.
    """
    all_rules = [
        *_of_bases(name, account, at_hub=at_hub),
        *_of_rights(name, rights(account.roles, level), level, plain, extra or Extra()),
    ]
    return tuple(dict.fromkeys(all_rules))


def metrics(right: Right, extra: Extra | None = None) -> tuple[str, ...]:
    """Return the metrics below ``incoming/`` that the right may write, with ``+`` for each placeholder ``{name}``."""
    declared = (channel if isinstance(channel, str) else channel.metric for channel in WRITES.get(right, ()))
    return (*(re.sub(r"{[^}]*}", "+", metric) for metric in declared), *getattr(extra, right, ()))


def covered(right: Right, filter_: str) -> str:
    """Return a metric of the contract that ``filter_`` matches and that ``right`` may not write, or "".

    A fleet's file (:class:`Extra`) may let a right write further filters, but none of those: it would get more power.
    """
    for channel in c.CHANNELS:
        if channel.direction == INCOMING and channel not in WRITES[right]:
            declared = re.sub(r"{[^}]*}", "+", channel.metric)
            if any(_overlap(filter_, other) for other in (declared, f"{BY}/+/{declared}")):
                return channel.metric
    return ""


def _overlap(filter_: str, other: str) -> bool:
    """True if some topic matches both filters, which have no #."""
    levels, other_levels = filter_.split("/"), other.split("/")
    pairs = zip(levels, other_levels, strict=False)
    return len(levels) == len(other_levels) and all(level == other or "+" in (level, other) for level, other in pairs)


def _of_bases(name: str, account: Account, *, at_hub: bool) -> Iterator[Rule]:
    """Yield the rules that an account has for its bases, as a neighbour, a robot, a gateway of boards or a gateway.

    ``at_hub``: for the hub of a LAN; else for the operators' broker.
    """
    roles = account.roles
    for base in account.bases:
        if ProgramRole.NEIGHBOUR in roles:
            if at_hub:  # neighbours meet only there
                yield from _of_neighbour(base)
        elif ProgramRole.BOARDS in roles and at_hub:
            continue  # no rule, as the robots that it carries are at a broker
        elif ProgramRole.BOARDS in roles or ProgramRole.ROBOT in roles:  # BOARDS: at the broker of the operators
            yield from (Rule(access, f"{base}/#") for access in ("read", "write"))
            if ProgramRole.ROBOT in roles and not at_hub:
                yield Rule("write", f"{c.SHORT}{name}")  # a short topic for groups of streams on a thin link
        else:
            yield from _of_gateway(base, at_hub=at_hub)
    if ProgramRole.GATEWAY in roles and not at_hub:
        yield from _of_gateway_heartbeats(name)


def _of_gateway(base: str, *, at_hub: bool) -> Iterator[Rule]:
    """Yield the rules of a gateway for a robot that it carries.

    At a broker it publishes for the robot, at a hub for the robot's operators. It keeps the flags of both sides equal.
    """
    yield from (Rule("read", f"{base}/{direction}/#") for direction in (INCOMING, OUTGOING))
    yield Rule("write", f"{base}/{INCOMING if at_hub else OUTGOING}/#")
    yield from (Rule("write", channel.filter(base)) for channel in c.CHANNELS if channel.kind is Kind.FLAG)


def _of_gateway_heartbeats(name: str) -> Iterator[Rule]:
    """Yield the rules of a gateway for heartbeats: it publishes its own, and reads those of all gateways."""
    yield Rule("read", c.ONLINE.filter(f"+/{GATEWAYS}/+"))
    yield Rule("write", c.ONLINE.filter(f"+/{GATEWAYS}/{name}"))


def _of_neighbour(base: str) -> Iterator[Rule]:
    """Yield the rules of a robot as a neighbour.

    It may command others only on topics with its own id, so that no other robot can claim to be this one.
    """
    kind, _, name = base.rpartition("/")
    yield Rule("read", f"{kind}/+/{OUTGOING}/#")
    yield Rule("write", f"{base}/{OUTGOING}/#")
    yield Rule("read", c.FROM_NEIGHBOUR.filter(base))
    yield Rule("write", c.FROM_NEIGHBOUR.topic(f"{kind}/+", robot=name))


def _of_expander() -> Iterator[Rule]:
    """Yield the rules of an expander: it reads groups of streams and publishes each stream on its own topic."""
    for channel in c.CHANNELS:
        if channel.kind is Kind.STREAM and channel.remote and channel.bridged and channel is not c.STREAMS:
            yield Rule("write", channel.filter(_ANY))
    # It reads how groups are written, the groups, and the announcements of all expanders, also those with an account in
    # the topic: they decide which one of several works.
    for suffix in (c.WIRE.suffix, c.STREAMS.suffix, c.EXPANDER.suffix, f"{INCOMING}/{BY}/+/{c.EXPANDER.metric}"):
        yield Rule("read", f"{_ANY}/{suffix}")
    yield Rule("read", f"{c.SHORT}+")  # the short topics of groups


def _of_rights(
    name: str, held: frozenset[Right], level: SecurityLevel, plain: Sequence[str], extra: Extra
) -> Iterator[Rule]:
    """Yield the rules of an account for its rights; ``plain`` and ``extra``: as in :func:`rules`."""
    if Right.LOOK in held:
        yield Rule("read", f"{_ANY}/{OUTGOING}/#")
        yield Rule("read", f"{_ANY}/{INCOMING}/flags/#")
    if Right.STOP in held:
        yield Rule("write", c.ESTOP.filter(_ANY))  # a stop needs no name, at any level
    bases_without_names = plain if level == "named" else (_ANY,)
    for right in [right for right in Right if right in held]:
        for metric in metrics(right, extra):
            if level == "named":
                yield Rule("write", f"{_ANY}/{INCOMING}/{BY}/{name}/{metric}")
            for base in bases_without_names:
                yield Rule("write", f"{base}/{INCOMING}/{metric}")
    if Right.DRIVE in held:  # `pebble doctor` checks a page server's account by a probe here, which no program reads
        yield Rule("write", c.BRIDGE_PROBE.filter(f"+/{SERVERS}/+"))
    if Right.EXPAND in held:
        yield from _of_expander()
