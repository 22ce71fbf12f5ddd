"""Writes configs/schema.json for editors; run it after every change of a section.

Program: ``python tools/schema.py [FOLDER]``; with a folder it writes the tables of all keys there instead.
"""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import fields

from pebble.config.config import full_tree
from pebble.config.reader import unwrap
from pebble.config.tree import Root
from pebble.config.types import Section
from pebble.extensions.checks.keys import keys_text

SCHEMA_FILE = Path("configs", "schema.json")
KEYS_FILE = "configuration.md"


def schema_text() -> str:
    """Return the JSON Schema of a config file. The reader also takes an empty string, as "not set"."""
    _, definitions = msgspec.json.schema_components(
        [full_tree()], schema_hook=lambda _kind: {"type": "string"}, ref_template="#/$defs/{name}"
    )
    for kind in _subclasses(Section):
        if kind.__name__ in definitions:
            _complete(definitions[kind.__name__], kind)
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Config of a Pebble robot",
        "$ref": f"#/$defs/{Root.__name__}",
        "$defs": dict(sorted(definitions.items())),
    }
    return json.dumps(schema, indent=1) + "\n"


def _complete(definition: dict[str, Any], kind: type[Section]) -> None:
    """Complete the schema of a section.

    It gets choices, comments, retired and other names of keys, and accepts a text in place of a list of texts. Defaults
    that are a whole section or null are left out: the keys of that section have defaults of their own.
    """
    properties = definition["properties"]
    for field in fields(kind):
        _, metas = unwrap(field.type)
        choices = [choice for meta in metas if meta.extra for choice in meta.extra.get("choices", ())]
        if choices:
            properties[field.encode_name]["enum"] = choices
    for value in properties.values():
        is_null = "default" in value and value["default"] is None
        if "$ref" in value or is_null:  # "$ref": a section
            value.pop("default", None)
        if value.get("items") == {"type": "string"}:
            value["type"] = ["array", "string"]  # words, or one line of them
    patterns: dict[str, Any] = {"^(//|_)": {"description": "A comment."}}
    for key, replacement in kind.all_retired().items():
        pattern = f"^{key[:-1]}" if key.endswith("*") else f"^{key}$"
        patterns[pattern] = {"deprecated": True, "description": f"No longer used: {replacement}."}
    for key, name in kind.other_names.items():
        patterns[f"^{key}$"] = {"deprecated": True, "description": f"Read as {name}."}
    definition["patternProperties"] = patterns


def _subclasses(kind: type[Section]) -> Iterator[type[Section]]:
    for child in kind.__subclasses__():
        yield child
        yield from _subclasses(child)


def main(arguments: list[str]) -> None:
    """Write the tables of all keys into the given folder; without one, the schema of this checkout."""
    if arguments and arguments[0].startswith("-"):
        sys.exit(__doc__)
    if arguments:
        folder = Path(arguments[0])
        folder.mkdir(parents=True, exist_ok=True)
        (folder / KEYS_FILE).write_text(keys_text(), encoding="utf-8")
    else:
        (Path(__file__).resolve().parents[1] / SCHEMA_FILE).write_text(schema_text(), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
