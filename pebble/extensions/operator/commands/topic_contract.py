"""``pebble topic contract``: the contract as a table, or as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from pebble.contract import CHANNELS, INCOMING, OUTGOING, Channel
from pebble.extensions.operator.client.names import base_of
from pebble.extensions.operator.contract.docs import authority, payload_name, rate, travels


def contract(
    base: Annotated[
        str | None, typer.Option("--base", help="Print the whole topics of this robot.", metavar="[SYSTEM/TYPE/]ID")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the contract as JSON.")] = False,
    json_schema: Annotated[bool, typer.Option("--json-schema", help="Print the JSON Schemas of all payloads.")] = False,
) -> int:
    """Print the contract: every topic, and how it is delivered.

    \b
        pebble topic contract
        pebble topic contract --base goob
        pebble topic contract --json | jq '.[] | select(.kind == "STATE").topic'
        pebble topic contract --json-schema > payloads.schema.json
    """
    prefix = "" if base is None else f"{base_of(base)}/"
    if json_schema:
        from pebble.extensions.operator.contract.schemas import schemas

        typer.echo(json.dumps(schemas(), indent=2))
    elif as_json:
        typer.echo(json.dumps([_plain(channel, prefix) for channel in CHANNELS], indent=2))
    else:
        _print_table(prefix)
    return 0


def _plain(channel: Channel, prefix: str) -> dict[str, Any]:
    return {
        "topic": prefix + channel.suffix,
        "direction": channel.direction,
        "kind": channel.kind.name,
        "meaning": channel.kind.meaning,
        "doc": channel.doc,
        "payload": payload_name(channel),
        "qos": channel.default_qos,
        "retain": channel.default_retain,
        "rate_hz": channel.rate_hz,
        "travels": travels(channel),
        "authority": authority(channel),
        "renamed_at": channel.override,
        "synonym_of": channel.synonym_of,
    }


def _print_table(prefix: str) -> None:
    from rich.text import Text

    from pebble.extensions.operator.commands.show import print_table

    rows = list[Sequence[str | Text]]()
    for direction in (INCOMING, OUTGOING):
        rows.append([Text(f"{prefix}{direction}/" if prefix else direction, style="bold")])
        for channel in CHANNELS:
            if channel.direction == direction:
                retained = "yes" if channel.default_retain else ""
                about = (channel.kind.name.lower(), str(channel.default_qos), retained, rate(channel), channel.doc)
                rows.append([f"  {channel.metric}", *about])
    columns = ("topic", "kind", "qos", "retained", "rate", "description")
    print_table(columns, rows, whole=("topic", "kind", "retained"), right=("qos", "rate"))
