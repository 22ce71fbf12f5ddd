"""The looks of robots on the operator page, as configs and capabilities name them."""

from typing import Literal

Colour = Literal["blue", "amber", "violet", "green", "coral", "rose", "teal", "slate"]
#: Its drawings of robots (pebble/extensions/page/static/faces.svg).
Body = Literal[
    "goob", "fred", "minilamp", "benjr", "pitcam", "outlets", "wheeled", "walker", "arm", "drone", "boat", "unknown"
]  # fmt: skip
