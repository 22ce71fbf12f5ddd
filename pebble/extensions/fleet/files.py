"""The files of ``pebble fleet hub`` and ``pebble fleet gateway``, and the connections that a gateway's asks for."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from pebble import contract as c
from pebble.config.config import default_run_folder
from pebble.config.problems import Notes
from pebble.config.raw import decode, plain, read_text
from pebble.config.reader import Reader, Rule, S
from pebble.config.rules.between_keys import CHECKS
from pebble.config.rules.doors import place_of
from pebble.config.transport import Mqtt, ZenohSection
from pebble.config.types import EMPTY, Account, CommonName, File, Level, Section, doc
from pebble.contract.identity import GATEWAYS, SERVERS, Identity
from pebble.errors import ConfigError
from pebble.runtime.connections import (
    LOCAL_RECONNECT_S,
    REMOTE_RECONNECT_S,
    client_of_hub,
    live_only,
    mqtt_settings,
    tls_settings,
)
from pebble.services.neighbours.config import RULES, Neighbours
from pebble.transports import Message, Transport, ZenohSettings, create

MOST_BOARDS = 16  # of one file that have neighbours: each has two connections and a thread


class HubFile(ZenohSection, frozen=True, kw_only=True):
    """A hub: the addresses where it listens, and the Zenoh routers that it connects to."""

    run_dir: Annotated[File | None, doc("Folder of its socket and lock; unset: one of its own.")] = None
    journal: Annotated[File | None, doc("File for what it retains; unset: memory only.")] = None
    access: Annotated[
        File | None, doc("File of `pebble fleet zenoh`: what each name of a certificate may do there.")
    ] = None
    allowed_names: Annotated[
        tuple[CommonName, ...] | None, doc("Without access: names (CN) of the certificates that may connect.")
    ] = None
    max_wills: Annotated[
        int, Meta(ge=1, le=1_000_000, description="Clients that may leave a will: a robot has one or two.")
    ] = 1000


class GatewayHub(ZenohSection, frozen=True, kw_only=True):
    """The hub."""

    account: Annotated[Account, doc("Its account at a hub with `access`: the name (CN) in tls.client_cert.")] = ""


class GatewayFile(Section, frozen=True, kw_only=True):
    """A gateway between a hub, or a LAN's broker, and the operators' broker."""

    id: Annotated[Level, doc("What it is called among gateways; unset: mqtt.username, the name of its account.")] = ""
    hub: Annotated[GatewayHub, doc("Where the robots are.")] = GatewayHub()
    boards: Annotated[
        Mqtt | None, doc("Instead of hub: the broker of a LAN at which boards are, and robots that speak MQTT.")
    ] = None
    mqtt: Annotated[
        Mqtt | None,
        doc("The broker of their operators; unset: 127.0.0.1, and beside `neighbours` none: no robot is carried."),
    ] = None
    robots: Annotated[tuple[str, ...], doc("Bases of the robots that it carries; + stands for any level.")] = (
        "pebble/robots/+",
    )
    neighbours: Annotated[
        dict[str, Neighbours],
        doc("By the base of a robot at `boards`, which runs no program: what services.neighbours is to others."),
    ] = EMPTY

    @property
    def operators(self) -> Mqtt | None:
        """Return the settings of the operators' broker; None if no robot is carried to one.

        That is a gateway which only lets robots of the LAN hear and drive the boards in ``neighbours``.
        """
        return self.mqtt or (None if self.neighbours else Mqtt())


@contextmanager
def _read(path: Path, kind: type[S], rules: Sequence[Rule] = CHECKS) -> Iterator[tuple[S, Notes]]:
    """Yield the content of a file, and notes of its mistakes. Raises ConfigError with all of them after the block."""
    reader = Reader(path.parent, os.environ, rules, file=path)
    yield reader.section(kind, plain(decode(read_text(path), path.name), reader.notes)), reader.notes
    if reader.notes.problems:
        raise ConfigError(list(dict.fromkeys(f"{path.name}: {problem}" for problem in reader.notes.problems)))


def load_hub(path: Path) -> ZenohSettings:
    """Read the file; return the settings of its hub. Raises ConfigError with all problems."""
    path = path.absolute()
    with _read(path, HubFile) as (hub, notes):
        if not hub.listen:
            notes.problem(("listen",), 'is missing: a hub is reached there, such as ["tls/0.0.0.0:7447"]')
    return ZenohSettings(
        run_dir=hub.run_dir or default_run_folder(f"hub {path}", os.environ),
        listen=hub.listen,
        connect=hub.connect,
        tls=tls_settings(hub.tls),
        allowed_names=hub.allowed_names,
        access=hub.access,
        lease_ms=hub.lease_ms,
        journal=hub.journal,
        max_wills=hub.max_wills,
    )


def load_gateway(path: Path) -> tuple[GatewayFile, str, Path]:
    """Read the file; return it with the gateway's name and its run directory.

    Raises ConfigError with all problems.
    """
    path = path.absolute()
    with _read(path, GatewayFile, (*CHECKS, *RULES)) as (gateway, notes):
        operators = gateway.operators
        name = gateway.id
        if not name and operators is not None:
            name = operators.username or ""
        if not name:
            notes.problem(("id",), "is missing: write what this gateway is called, such as gate-1")
        if not gateway.robots:
            notes.problem(("robots",), 'is empty: write such as ["pebble/robots/+"]')
        for at, base in enumerate(gateway.robots):
            if not _is_base(base):
                notes.problem(
                    ("robots", str(at)), f"{base!r} is no base: write SYSTEM/TYPE/ID, such as pebble/robots/+"
                )
        _check_sides(notes, gateway, operators)
        _check_neighbours(notes, gateway)
    return gateway, name, default_run_folder(f"gateway {path}", os.environ)


def _check_sides(notes: Notes, gateway: GatewayFile, operators: Mqtt | None) -> None:
    boards = gateway.boards
    if boards is None and not gateway.hub.connect:
        notes.problem(("hub", "connect"), 'is missing: write where the hub listens, such as ["tls/hub1.lab:7447"]')
    if boards is not None and gateway.hub.connect:
        notes.problem(("boards",), "must be left out beside hub: write a second file for it, with an id of its own")
    if gateway.hub.listen:
        notes.problem(("hub", "listen"), "must be left out: a gateway is a client of hubs")
    if boards is not None and operators is not None and place_of(boards) == place_of(operators):
        notes.problem(("mqtt",), "is also boards: operators reach these robots there without a gateway")


def _check_neighbours(notes: Notes, gateway: GatewayFile) -> None:
    """Note mistakes in ``neighbours``: it does for each board what services.neighbours does in a robot's own config."""
    if gateway.neighbours and gateway.boards is None:
        notes.problem(("neighbours",), "must be left out without boards: a robot at a hub has its own")
    if len(gateway.neighbours) > MOST_BOARDS:
        notes.problem(("neighbours",), f"has {len(gateway.neighbours)} robots: {MOST_BOARDS} are the most")
    for base, robot in gateway.neighbours.items():
        path = ("neighbours", base)
        if "+" in base or not _is_base(base):
            notes.problem(path, f"{base!r} is no base: write SYSTEM/TYPE/ID, such as pebble/robots/minilamp")
        if not robot.lan.connect:
            notes.problem((*path, "lan", "connect"), 'is missing: write where the hub listens: ["tls/hub.lab:7447"]')
        if robot.listens:
            notes.problem((*path, "listens"), "must be left out: no script of this robot runs here")


def _is_base(base: str) -> bool:
    try:
        Identity(*("any" if level == "+" else level for level in base.split("/")))
    except (ConfigError, TypeError):
        return False
    return base.split("/")[1] not in (SERVERS, GATEWAYS)


def gateway_transports(
    gateway: GatewayFile, operators: Mqtt, run_dir: Path, will: Message
) -> tuple[Transport, Transport, Transport, Transport]:
    """Return a gateway's connections: one to the robots' hub, three to the operators' broker.

    Of the three, one is for its heartbeats with its will, and one for stops.
    """
    base = will.topic.removesuffix(f"/{c.ONLINE.suffix}")
    forwards = mqtt_settings(operators, as_published=True, reconnect_max_s=REMOTE_RECONNECT_S)
    apart = mqtt_settings(operators, reconnect_max_s=REMOTE_RECONNECT_S)
    return (
        _robots_transport(gateway, base, run_dir),
        create("mqtt", f"{base}/forwards", forwards),
        create("mqtt", f"{base}/presence", apart, will=will),
        create("mqtt", f"{base}/stops", live_only(apart)),
    )


def _robots_transport(gateway: GatewayFile, base: str, run_dir: Path) -> Transport:
    if gateway.boards is not None:
        settings = mqtt_settings(gateway.boards, as_published=True, reconnect_max_s=LOCAL_RECONNECT_S)
        return create("mqtt", f"{base}/boards", settings)
    hub = gateway.hub
    return create("zenoh", f"{base}-hub", client_of_hub(run_dir, hub, hub.lease_ms, hub.account))
