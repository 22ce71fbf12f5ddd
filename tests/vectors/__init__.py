"""Packets and commands, and what they have to become: put together from the byte layouts alone, by nothing of Pebble.

pbat.json: big-endian magic, version u8, codec u8, channels u8, flags u8, rate u16, samples u16, sequence u32,
milliseconds u64; then interleaved little-endian samples. video.json: a film of 64x48, each fourth picture a key frame,
with differences from the receiver's picture, as newer revisions make them, or from the camera's, as the paper has it.
"""

from pathlib import Path
from typing import Any

import msgspec


def vectors(name: str) -> Any:
    """Return the content of a file of this folder."""
    return msgspec.json.decode(Path(__file__).with_name(name).read_bytes())
