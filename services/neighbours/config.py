"""The config section of robots that hear and drive each other on a LAN."""

import re
from collections.abc import Iterator
from typing import Annotated, ClassVar

from pebble.config import Config
from pebble.config.hosts import is_loopback
from pebble.config.problems import Path
from pebble.config.reader import Reader, Rule
from pebble.config.rules.doors import zenoh_endpoints
from pebble.config.transport import ZenohClient
from pebble.config.tree import Root
from pebble.config.types import EMPTY, ONE_VALUE, Account, Level, Section, ServiceSection, Topic, doc
from pebble.contract import DRIVE, OUTGOING, channel_of, is_reserved
from pebble.extension import Facts

MOST_NEIGHBOURS, MOST_METRICS = 16, 32  # of one robot; metrics of one neighbour
_LAN: Path = ("services", "neighbours", "lan")
_EVERYWHERE = ("0.0.0.0", "::")  # noqa: S104 -- compared only


class Lan(ZenohClient, frozen=True, kw_only=True):
    """The hub where robots meet. They are its clients: none listens."""

    retired: ClassVar = {"lease_ms": ONE_VALUE, "settings": "the hub is of Zenoh", "listen": "robots meet at a hub"}

    account: Annotated[
        Account, doc("The account of `pebble fleet add … --role neighbour` at a hub with `access`: the name (CN) in "
                     "tls.client_cert.")
    ] = ""  # fmt: skip

    #: A link that stood still for less than this delivers what waited; commands should not be among it.
    lease_ms: ClassVar[int] = 500


class Neighbours(ServiceSection, frozen=True, kw_only=True):
    """Scripts of other robots hear and drive this one, as far as it lets them: docs/ext/neighbours.md."""

    lan: Annotated[Lan, doc("Where the robots meet.")] = Lan()
    shares: Annotated[
        tuple[Topic, ...], doc('What the others may receive: metrics of outgoing/, such as "wheel-odometry".')
    ] = ()
    commanded: Annotated[
        dict[Level, tuple[Topic, ...]],
        doc('By the id of another robot, what its scripts may command: {"goob": ["drive-values"]}.'),
    ] = EMPTY
    listens: Annotated[
        dict[Level, tuple[Topic, ...]],
        doc('By the id of another robot, what this one\'s scripts hear of it: {"fred": ["wheel-odometry"]}.'),
    ] = EMPTY

    def connections(self) -> Iterator[tuple[tuple[str, ...], Section]]:
        if self.enabled:
            yield ("lan",), self.lan


def _check(reader: Reader, section: Neighbours, path: Path) -> Neighbours:
    problem, lan = reader.notes.problem, section.lan
    if section.enabled and not lan.connect:
        reader.notes.doubt((*path, "lan", "connect"), 'is missing, write where the hub listens: ["tls/hub.lab:7447"]')
    if lan.account and (not lan.tls.enabled or lan.tls.client_cert is None):
        problem((*path, "lan", "account"), "needs tls.client_cert, in which it is the name")
    for key, names in (("commanded", section.commanded), ("listens", section.listens)):
        if len(names) > MOST_NEIGHBOURS:
            problem((*path, key), f"has {len(names)} robots: {MOST_NEIGHBOURS} are the most")
    for name, granted in section.commanded.items():
        if any(metric != DRIVE.metric for metric in granted):
            problem((*path, "commanded", name), f'must be ["{DRIVE.metric}"]: nothing else can be granted')
    metrics_at: dict[Path, tuple[str, ...]] = {("shares",): section.shares}  # by the path of their key
    for name, heard in section.listens.items():
        metrics_at["listens", name] = heard
    for place, metrics in metrics_at.items():
        if len(metrics) > MOST_METRICS:
            problem((*path, *place), f"has {len(metrics)} metrics: {MOST_METRICS} are the most")
        for metric in metrics:
            channel = channel_of(f"{OUTGOING}/{metric}")
            is_forwarded = channel is None or (channel.remote and channel.bridged)  # by bridges, to operators
            if is_reserved(metric) or not is_forwarded:
                problem((*path, *place), f"{metric} cannot be shared: no pictures or sound, nor who stops and drives")
    return section


def _check_hub(reader: Reader, root: Root, _: Path) -> Root:
    """Note a problem if the hub of the LAN is also the operators' hub, or the robot's."""
    endpoints = list(zenoh_endpoints(root))
    hubs = {_place_of(endpoint): endpoint for path, endpoint in endpoints if path[:3] == _LAN}
    for path, endpoint in endpoints:
        hub = hubs.get(_place_of(endpoint))
        if hub is not None and path[:3] != _LAN:
            why = f"is also {'.'.join(map(str, path))}: what is shared would come twice, or without end"
            reader.notes.problem((*_LAN, "connect"), f"{hub} {why}; take another hub")
    return root


def _place_of(endpoint: str) -> tuple[str, str]:
    """Return host and port of an endpoint; all names of this machine are one host."""
    host, _, port = re.sub(r"[?#].*", "", endpoint.partition("/")[2]).rpartition(":")
    host = host.strip("[]")
    return ("" if host in _EVERYWHERE or is_loopback(host) else host), port


RULES: tuple[Rule, ...] = ((Neighbours, _check), (Root, _check_hub))


def facts(config: Config) -> Facts:
    """Return the line of the summary about the LAN."""
    section = config.section(Neighbours)
    if not section.enabled:
        return Facts()
    ways = [f"connects to {endpoint}" for endpoint in section.lan.connect]
    drivers = [name for name, granted in section.commanded.items() if granted]
    names_of = {"receives": section.listens, "driven by scripts of": drivers, "shares": section.shares}
    lists = (f"{what} {' and '.join(names)}" for what, names in names_of.items() if names)
    return Facts((("lan", ", ".join([*ways, *lists])),))
