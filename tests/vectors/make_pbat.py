"""Writes pbat.json: PBAT packets put together from the byte layout alone, and what has to become of each.

Run ``python -m tests.vectors.make_pbat``. Layout: big-endian magic, version u8, codec u8, channels u8, flags u8,
rate u16, samples u16, sequence u32, milliseconds u64; then interleaved little-endian samples.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

FILE = Path(__file__).with_name("pbat.json")


def packet(
    samples: list[int],
    *,
    magic: bytes = b"PBAT",
    version: int = 1,
    codec: int = 1,
    channels: int = 1,
    flags: int = 0,
    rate: int = 16000,
    count: int | None = None,
    sequence: int = 1,
    ms: int = 1_700_000_000_000,
) -> bytes:
    count = len(samples) // max(channels, 1) if count is None else count
    head = magic + struct.pack(">BBBBHHIQ", version, codec, channels, flags, rate, count, sequence, ms)
    return head + struct.pack(f"<{len(samples)}h", *samples)


RAMP = list(range(-160, 160))
STEREO = [value for pair in zip(RAMP, RAMP[::-1], strict=True) for value in pair]


def played(name: str, raw: bytes, *, rate: int = 16000, channels: int = 1, samples: list[int]) -> dict[str, object]:
    return {"name": name, "hex": raw.hex(), "rate": rate, "channels": channels, "samples": samples}


def refused(name: str, raw: bytes) -> dict[str, object]:
    return {"name": name, "hex": raw.hex(), "samples": None}


def vectors() -> list[dict[str, object]]:
    return [
        played("20 ms mono", packet(RAMP), samples=RAMP),
        played("20 ms stereo", packet(STEREO, channels=2), channels=2, samples=STEREO),
        played("highest rate", packet([1, -1], rate=65535), rate=65535, samples=[1, -1]),
        played("extremes", packet([-32768, 32767]), samples=[-32768, 32767]),
        played("highest sequence", packet([5], sequence=0xFFFFFFFF), samples=[5]),
        played("no clock", packet([5], ms=0), samples=[5]),
        played("latest time", packet([5], ms=2**64 - 1), samples=[5]),
        played("unknown flags", packet([5], flags=255), samples=[5]),
        played("extra bytes", packet([5, 6, 7], count=2), samples=[5, 6]),
        refused("empty", b""),
        refused("magic only", b"PBAT"),
        refused("header cut", packet([5])[:23]),
        refused("no body", packet([5])[:24]),
        refused("body cut", packet([5])[:25]),
        refused("other magic", packet([5], magic=b"PBVD")),
        refused("version 2", packet([5], version=2)),
        refused("unknown codec", packet([5], codec=3)),
        refused("no channels", packet([5], channels=0, count=1)),
        refused("no rate", packet([5], rate=0)),
        refused("no samples", packet([], count=0)),
        refused("more samples than sent", packet([5], count=2)),
        refused("255 channels", packet([5] * 255, channels=255)),
        refused("nobody speaks at 1 Hz", packet([5], rate=1)),
        refused("longer than a second", packet([5] * 4001, rate=4000)),
        refused("Opus without a packet", packet([], codec=2, count=320)),
        refused("Opus packet cut", packet([0x0A00, 0x4848], codec=2, count=320)),
        refused("Opus at 44.1 kHz", packet([0x0200, 0x0848], codec=2, count=882, rate=44100)),
        refused("Opus of another length", packet([0x0200, 0x0848], codec=2, count=321)),
    ]


if __name__ == "__main__":
    FILE.write_text("[\n" + ",\n".join(map(json.dumps, vectors())) + "\n]\n")
