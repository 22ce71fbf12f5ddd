"""The bridge to a base with ROS 1 (a Husky, Jackal or TurtleBot), which then is a robot like any other."""

from pebble.extension import Extension

_CONFIG = "pebble.services.ros1_bridge.config"

EXTENSION = Extension(
    name="ros1_bridge",
    extra="ros1",
    sections={"services.ros1_bridge": f"{_CONFIG}:Ros1"},
    rules=f"{_CONFIG}:RULES",
    programs=f"{_CONFIG}:programs",
    offers=f"{_CONFIG}:offers",
    facts=f"{_CONFIG}:facts",
    checks="pebble.services.ros1_bridge.checks:checks",
    motors={"ros1": "ros1_bridge"},
    page="docs/ext/ros1.md",
)
