"""What the demo counts of pictures and sound."""

from __future__ import annotations

import numpy as np

from pebble.contract.encodings import ALL_SOUND, ALL_VIDEO
from pebble.extensions.lab.demo.media import CountedMedia
from pebble.extensions.media.decode import Decoded
from pebble.extensions.media.sound import ReceivedSound
from pebble.transports import create
from pebble.transports.memory import MemoryHub


def test_an_encoding_of_which_nothing_arrives_is_missing() -> None:
    black = np.zeros((2, 2, 3), np.uint8)
    with create("memory", "viewer", MemoryHub()) as transport:
        media = CountedMedia(transport, "pebble/robots/goob")
        for encoding in ALL_VIDEO[1:]:
            media.on_picture(Decoded(black, None, None, True, encoding))
        for encoding in ALL_SOUND[1:]:
            media.on_sound(ReceivedSound(np.zeros((320, 1), np.int16), 16_000, 1, 0, 0, encoding))
        assert media.missing() == [ALL_VIDEO[0], ALL_SOUND[0]]
