"""A LAN of robots: they hear each other, and scripts of one drive another that permits it."""

from pebble.extension import Extension, Program

EXTENSION = Extension(
    name="neighbours",
    needs=("scripts", "operator"),
    sections={"services.neighbours": "pebble.services.neighbours.config:Neighbours"},
    rules="pebble.services.neighbours.config:RULES",
    program=Program("neighbours", "pebble.services.neighbours.service:NeighboursService", preloaded=False),
    facts="pebble.services.neighbours.config:facts",
    page="docs/ext/neighbours.md",
)
