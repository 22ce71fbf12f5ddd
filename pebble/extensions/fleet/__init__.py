"""Fleets: brokers' accounts and the page's people, their rights, certificates, the audit, and gateways."""

from pebble.extension import Command, Extension

EXTENSION = Extension(
    name="fleet",
    needs=("operator", "neighbours"),
    observer="pebble.extensions.fleet.robot_audit:Audit",
    names="pebble.extensions.fleet.names:CheckedNames",
    accounts="pebble.extensions.fleet.hub_access:AccountAdmission",
    commands={
        "fleet": Command(
            "pebble.extensions.fleet.commands.group", "give robots and people accounts at a broker", "share", 10
        ),
        "fleet hub": Command(
            "pebble.extensions.fleet.commands.hub:hub", "Run a Zenoh hub for several robots.", "share", 11
        ),
        "fleet gateway": Command(
            "pebble.extensions.fleet.commands.gateway:gateway",
            "Carry robots of a hub or a LAN to a broker.",
            "share",
            12,
        ),
        "fleet audit": Command(
            "pebble.extensions.fleet.commands.audit:audit", "Print who did what to a robot.", "share", 13
        ),
    },
    former={"hub": "fleet hub", "gateway": "fleet gateway", "audit": "fleet audit"},
    page="docs/ext/fleet.md",
)
