"""The file of ``pebble gateway``: a Zenoh hub with robots, the MQTT broker of their operators, and which robots."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pebble.config.config import default_run_folder
from pebble.config.raw import decode, plain, read_text
from pebble.config.reader import Reader
from pebble.config.rules.between_keys import CHECKS
from pebble.config.transport import Mqtt, ZenohSection
from pebble.config.types import Account, Level, Section, doc
from pebble.contract.identity import GATEWAYS, SERVERS, Identity
from pebble.errors import ConfigError


class GatewayHub(ZenohSection, frozen=True, kw_only=True):
    """The hub, or several that are linked."""

    account: Annotated[Account, doc("Its account at a hub with `access`: the name (CN) in tls.client_cert.")] = ""


class GatewayFile(Section, frozen=True, kw_only=True):
    """A gateway between one hub and one broker."""

    id: Annotated[Level, doc("What it is called among gateways; unset: mqtt.username, the name of its account.")] = ""
    hub: Annotated[GatewayHub, doc("Where the robots are.")] = GatewayHub()
    mqtt: Annotated[Mqtt, doc("The broker of their operators.")] = Mqtt()
    robots: Annotated[tuple[str, ...], doc("Bases of the robots that it carries; + stands for any level.")] = (
        "pebble/robots/+",
    )


def load_gateway(path: Path, env: Mapping[str, str] = os.environ) -> tuple[GatewayFile, str, Path]:
    """Read such a file; returns it, the gateway's name, and its run directory. Raises ConfigError with all problems."""
    path = path.absolute()
    reader = Reader(path.parent, env, CHECKS)
    problem = reader.notes.problem
    gateway = reader.section(GatewayFile, plain(decode(read_text(path), path.name), reader.notes))
    name = gateway.id or gateway.mqtt.username or ""
    if not name:
        problem(("id",), "is missing: write what this gateway is called, such as gate-1")
    if not gateway.hub.connect:
        problem(("hub", "connect"), 'is missing: write where the hub listens, such as ["tls/hub1.lab:7447"]')
    if gateway.hub.listen:
        problem(("hub", "listen"), "must be left out: a gateway is a client of hubs")
    if gateway.mqtt.hosts:
        problem(("mqtt", "hosts"), "cannot be several: gateways agree at one broker; write host, and run others for it")
    if not gateway.robots:
        problem(("robots",), 'is empty: write such as ["pebble/robots/+"]')
    for at, base in enumerate(gateway.robots):
        if not _is_base(base):
            problem(("robots", str(at)), f"{base!r} is no base: write SYSTEM/TYPE/ID, such as pebble/robots/+")
    if reader.notes.problems:
        raise ConfigError(list(dict.fromkeys(f"{path.name}: {one}" for one in reader.notes.problems)))
    return gateway, name, default_run_folder(f"gateway {path}", env)


def _is_base(base: str) -> bool:
    try:
        Identity(*("any" if level == "+" else level for level in base.split("/")))
    except (ConfigError, TypeError):
        return False
    return base.split("/")[1] not in (SERVERS, GATEWAYS)
