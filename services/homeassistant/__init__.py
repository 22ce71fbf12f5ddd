"""The robot as a device of Home Assistant: its state, its lights, and a button that stops it."""

from pebble.extension import Extension

_CONFIG = "pebble.services.homeassistant.config"

EXTENSION = Extension(
    name="homeassistant",
    needs=("operator",),
    extra="homeassistant",
    sections={"services.homeassistant": f"{_CONFIG}:HomeAssistant"},
    rules=f"{_CONFIG}:RULES",
    programs=f"{_CONFIG}:programs",
    facts=f"{_CONFIG}:facts",
    page="docs/ext/homeassistant.md",
)
