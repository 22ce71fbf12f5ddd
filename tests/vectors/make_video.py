"""Makes video.json: streams as the reference implementation puts them on the wire, written from the byte layouts alone.

Nothing of Pebble is used here. Run ``python -m tests.vectors.make_video`` to write the file again.
"""

from __future__ import annotations

import base64
import json
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

FILE = Path(__file__).with_name("video.json")
WIDTH, HEIGHT, KEYFRAME_EVERY, QUALITY = 64, 48, 4, 10
FIRST_MS, STEP_MS = 1_710_969_600_123, 66


def camera(number: int) -> np.ndarray:
    """A disc that crosses stripes."""
    picture = np.full((HEIGHT, WIDTH, 3), (90, 120, 70), np.uint8)
    picture[:, ::16] = (200, 180, 40)
    cv2.circle(picture, (10 + 5 * number, 24), 9, (40, 60, 220), -1)
    return picture


def jpeg(picture: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()


def pixels(packed: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(packed, np.uint8), cv2.IMREAD_COLOR).astype(int)


def film(count: int, *, mended: bool) -> list[tuple[bool, bytes, np.ndarray]]:
    """(key frame, JPEG, what a receiver has then). ``mended``: differences from the receiver's picture, as newer
    revisions make them; otherwise from the camera's previous one, as the paper describes it."""
    made = []
    reference, received = np.zeros(0), np.zeros(0)
    for number in range(count):
        now = camera(number).astype(int)
        keyframe = number % KEYFRAME_EVERY == 0
        packed = jpeg((now if keyframe else np.clip(now - reference + 128, 0, 255)).astype(np.uint8))
        received = pixels(packed) if keyframe else np.clip(received + pixels(packed) - 128, 0, 255)
        reference = received if mended else now
        made.append((keyframe, packed, received))
    return made


def as_json(number: int, keyframe: bool, packed: bytes) -> bytes:
    data = base64.b64encode(zlib.compress(packed)).decode()
    stamp = (FIRST_MS + number * STEP_MS) / 1000
    return json.dumps({"id": number, "keyframe": keyframe, "data": data, "timestamp": stamp}).encode()


def as_pbvd(number: int, keyframe: bool, packed: bytes) -> bytes:
    return _pbvd(1 if keyframe else 2, number) + packed


def as_pbvz(number: int, keyframe: bool, packed: bytes) -> bytes:
    return _pbvd(3 if keyframe else 4, number) + zlib.compress(packed)


def as_jpeg(_number: int, _keyframe: bool, packed: bytes) -> bytes:
    return packed


def _pbvd(kind: int, number: int) -> bytes:
    return struct.pack(">4sBBBIQ", b"PBVD", 1, kind, 0, number, FIRST_MS + number * STEP_MS)


def shown(packet: bytes, number: int | None, picture: np.ndarray) -> dict[str, Any]:
    """A step after which this picture is on the screen. ``cells``: the means of blocks of 8x8 pixels, BGR."""
    cells = picture.reshape(HEIGHT // 8, 8, WIDTH // 8, 8, 3).mean((1, 3)).round().astype(int)
    return {"packet": base64.b64encode(packet).decode(), "shows": {"frame": number, "cells": cells.tolist()}}


def hidden(packet: bytes) -> dict[str, Any]:
    """A step that must show nothing."""
    return {"packet": base64.b64encode(packet).decode(), "shows": None}


def streams() -> dict[str, list[dict[str, Any]]]:
    mended, camera_only = film(6, mended=True), film(6, mended=False)
    made: dict[str, list[dict[str, Any]]] = {}
    for form, pack in (("json", as_json), ("pbvd", as_pbvd), ("pbvz", as_pbvz)):
        for rule, frames in (("receiver", mended), ("camera", camera_only)):
            made[f"{form}, differences from the {rule}'s picture"] = [
                shown(pack(number, keyframe, packed), number, picture)
                for number, (keyframe, packed, picture) in enumerate(frames)
            ]
        packets = [pack(number, keyframe, packed) for number, (keyframe, packed, _) in enumerate(mended)]
        good = [shown(packet, number, mended[number][2]) for number, packet in enumerate(packets)]
        made[f"{form}, joined late"] = [hidden(packets[2]), hidden(packets[3]), good[4], good[5]]
        made[f"{form}, one lost"] = [good[0], hidden(packets[2]), hidden(packets[3]), good[4]]
        made[f"{form}, one twice"] = [good[0], good[1], hidden(packets[1]), hidden(packets[2]), good[4]]
        made[f"{form}, sender restarted"] = [good[4], good[5], good[0], good[1]]
        made[f"{form}, cut short"] = [good[0], hidden(packets[1][:-40]), hidden(packets[2]), good[4]]
        made[f"{form}, key frame cut short"] = [hidden(packets[0][:-40]), hidden(packets[1]), good[4]]
        made[f"{form}, garbage between"] = [good[0], hidden(b"\x00garbage"), hidden(packets[1]), good[4]]
    key = [(number, packed) for number, (keyframe, packed, _) in enumerate(mended) if keyframe]
    whole = [shown(as_jpeg(number, True, packed), None, mended[number][2]) for number, packed in key]
    made["raw jpeg"] = whole
    made["raw jpeg, cut short"] = [whole[0], hidden(key[1][1][:-20]), whole[1]]
    made["form changes"] = [
        shown(as_json(0, True, mended[0][1]), 0, mended[0][2]),
        hidden(as_pbvd(1, False, mended[1][1])),
        shown(as_pbvd(4, True, mended[4][1]), 4, mended[4][2]),
        shown(as_pbvd(5, False, mended[5][1]), 5, mended[5][2]),
        shown(key[0][1], None, mended[0][2]),
        hidden(as_pbvd(6, False, mended[1][1])),
    ]
    return made


def main() -> None:
    lines = [f"{json.dumps(name)}: {json.dumps(steps, separators=(',', ':'))}" for name, steps in streams().items()]
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    main()
