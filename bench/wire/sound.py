"""Measures bytes of each sound encoding, with the headers of MQTT, TCP and IP."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pebble.bench.comparison import Budget, Case, Comparison, Measuring, Report
from pebble.bench.judging.aims import Aim, single
from pebble.bench.pictures import bars
from pebble.bench.results import Cell, Value
from pebble.bench.tables import Grid, percentile_column, single_column
from pebble.bench.wire.cells import Coded, wire_cell
from pebble.contract import AUDIO
from pebble.media.opus import BUNDLE_LIMIT
from pebble.media.pcm import to_bytes
from pebble.media.sound import SoundDecoder, make_sound_encoder
from pebble.media.speech import Speech

TOPIC = AUDIO.topic("pebble/robots/goob")
AIM = 0.16  # of PCM's bytes
RATE = 16_000
_HEADERS = 20 + 32  # bytes: IP version 4 without options, TCP with time stamps as Linux sends them
_CHUNK_MS = 20


def wire_bytes(payload: int) -> int:
    """Size of one PUBLISH with QoS 0 in a TCP segment of its own (MQTT 3.1.1, 3.3)."""
    length = 2 + len(TOPIC) + payload
    digits = max(1, (length.bit_length() + 6) // 7)  # of the remaining length
    return _HEADERS + 1 + digits + length


def measure_sound(case: Case) -> Iterator[Cell]:
    """One cell per encoding; PCM comes first, as the reference of the others."""
    speech = Speech(RATE).samples(0, round(case.run["seconds"] * RATE))
    pcm = speak(speech, "pcm")
    yield wire_cell(replace(case, role="pcm"), "kbit/s", pcm, pcm)
    for bitrate, bundle in itertools.product(case.run["bitrates"], range(1, BUNDLE_LIMIT + 1)):
        packet = "1 part" if bundle == 1 else f"{bundle} parts"
        params: dict[str, Value] = {"bitrate": f"{bitrate // 1000} kbit/s", "packet": packet}
        yield wire_cell(replace(case, role="opus"), "kbit/s", speak(speech, "opus", bitrate, bundle), pcm, params)


def speak(speech: np.ndarray, name: str, bitrate: int = 24_000, bundle: int = 1) -> Coded:
    """Encodes and decodes the speech."""
    encoder = make_sound_encoder(name, rate=RATE, channels=1, chunk_ms=_CHUNK_MS, bitrate=bitrate, bundle=bundle)
    size, decoder, packets = RATE * _CHUNK_MS // 1000, SoundDecoder(), list[bytes]()
    for at in range(0, len(speech), size):
        packets += encoder.encode(to_bytes(speech[at : at + size]), round(1000 * at / RATE))
    received = sum(len(one.samples) for one in map(decoder.feed, packets) if one is not None)
    lasts_s = received / encoder.rate
    return {
        "wire": sum(wire_bytes(len(packet)) for packet in packets) / lasts_s * 8 / 1000,
        "packets_per_s": len(packets) / lasts_s,
        "payload_kbits": sum(map(len, packets)) * 8 / 1000 / lasts_s,
    }


_BUDGET = Budget(6, seconds=10.0, bitrates=(16_000, 24_000, 32_000))
SOUND = Comparison(
    name="sound",
    title="Sound on the wire",
    what="Bytes of each sound encoding with the headers of MQTT, TCP and IP. Nothing is sent: these are the "
    "encoders' bytes for synthetic speech.",
    help="Sound on the wire: bytes of every encoding, with all headers.",
    full=_BUDGET,
    quick=_BUDGET,
    constants={"rate": RATE},
    measuring=Measuring(measure=measure_sound),
    report=Report(
        tables=(
            Grid(
                title=f"Sound of {RATE / 1000:g} kHz mono on the wire, chunks of {_CHUNK_MS} ms",
                rows=("variant", "bitrate", "packet"), heads=("encoding", "", ""),
                columns=(
                    single_column("pack./s", "packets_per_s", ".1f"), single_column("payload", "payload_kbits", ".1f"),
                    percentile_column(50, "wire"), single_column("× PCM", "ratio", ".3f"),
                ),
                caption=f"payload, wire: kbit/s, topic {TOPIC}",
            ),
        ),
        assessment=(
            Aim(
                what=f"Opus with several parts in a packet takes at most {AIM} of PCM's bytes",
                of=lambda cell: cell.variant == "opus" and cell.params["packet"] != "1 part",
                value=single("ratio"), at_most=AIM, worst=True, shown="{:.3f}".format,
            ),
        ),
        pictures=(bars("Sound"),),
    ),
)  # fmt: skip
