"""Adds a section to a robot's config, a line to `pebble check` and a check to `pebble doctor`.

The config names it, "extensions": {"extension.py": {}}, and may have "lamp": {"watts": 5} then; a key that is written
wrongly is an error that names the nearest.
"""

from collections.abc import Iterator
from typing import Annotated

from pebble.check_result import CheckResult, ok, warn
from pebble.config import Config
from pebble.config.types import Section, doc
from pebble.extension import Extension, Facts


class Lamp(Section, frozen=True, kw_only=True):
    """A lamp at the robot's battery."""

    watts: Annotated[float, doc("What it takes.")] = 3.0


def facts(config: Config) -> Facts:
    return Facts((("lamp", f"takes {config.section(Lamp).watts:g} W"),))


def checks(config: Config) -> Iterator[CheckResult]:
    watts = config.section(Lamp).watts
    yield ok(f"{watts:g} W") if watts <= 10 else warn("it empties the battery in an hour", "set lamp.watts")


EXTENSION = Extension(
    name="lamp",
    package="extension.py",
    sections={"lamp": "extension:Lamp"},
    facts="extension:facts",
    checks="extension:checks",
)
