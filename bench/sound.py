"""Measures bytes of sound on the wire: Opus against the original's PCM, with headers of MQTT, TCP and IP."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pebble.bench.aims import Aim, single
from pebble.bench.comparison import Budget, Case, Comparison, Run
from pebble.bench.pictures import bars
from pebble.bench.results import Cell, Value
from pebble.bench.tables import Grid, percentile_column, single_column
from pebble.contract import AUDIO
from pebble.errors import PebbleError
from pebble.media.opus import BUNDLE_LIMIT
from pebble.media.pcm import to_bytes
from pebble.media.sound import SOUND_ENCODINGS, SoundDecoder, make_sound_encoder
from pebble.media.speech import Speech

TOPIC = AUDIO.topic("pebble/robots/goob")
AIM = 0.16  # of PCM's bytes
BITRATES = (16_000, 24_000, 32_000)
RATE = 16_000
_IP, _TCP = 20, 32  # bytes; version 4 without options, TCP with time stamps as Linux sends them
_CHUNK_MS = 20
_DELAY_S = 0.02  # at most, of codec and resampler
_STEP_S = 0.02  # of an envelope

Wave = npt.NDArray[np.float64]


def wire_bytes(payload: int, topic: str = TOPIC) -> int:
    """Size of one PUBLISH with QoS 0 in a TCP segment of its own (MQTT 3.1.1, 3.3)."""
    length = 2 + len(topic.encode()) + payload
    digits = max(1, (length.bit_length() + 6) // 7)  # of the remaining length
    return _IP + _TCP + 1 + digits + length


def measure(case: Case) -> Iterator[Cell]:
    """One cell per encoding; PCM comes first, as the reference of the others."""
    speech = Speech(RATE).samples(0, round(case.run["seconds"] * RATE))
    pcm = _coded(speech, "pcm")
    yield _cell(case, "pcm", pcm, pcm, {})
    for bitrate in case.run["bitrates"]:
        for bundle in range(1, BUNDLE_LIMIT + 1):
            parts = "1 part" if bundle == 1 else f"{bundle} parts"
            opus = _coded(speech, "opus", bitrate, bundle)
            yield _cell(case, "opus", opus, pcm, {"bitrate": f"{bitrate // 1000} kbit/s", "packet": parts})


def _coded(speech: npt.NDArray[np.int16], name: str, bitrate: int = 24_000, bundle: int = 1) -> dict[str, float]:
    """Values for a second of sound; ``likeness``: of the samples for PCM, of the envelopes for Opus."""
    encoder = make_sound_encoder(name, rate=RATE, channels=1, chunk_ms=_CHUNK_MS, bitrate=bitrate, bundle=bundle)
    size = RATE * _CHUNK_MS // 1000
    began = time.process_time()
    packets = []
    for at in range(0, len(speech), size):
        packets += encoder.encode(to_bytes(speech[at : at + size]), round(1000 * at / RATE))
    encoded = time.process_time()
    decoder = SoundDecoder()
    received = [one.samples for one in map(decoder.feed, packets) if one is not None]
    decoded = time.process_time()
    sound = np.concatenate(received)[:, 0].astype(np.float64)
    seconds = len(sound) / encoder.rate
    return {
        "wire_kbits": sum(wire_bytes(len(packet)) for packet in packets) / seconds * 8 / 1000,
        "packets_per_s": len(packets) / seconds,
        "payload_kbits": sum(map(len, packets)) * 8 / 1000 / seconds,
        "likeness": likeness(sound, speech[:, 0].astype(np.float64), RATE, by_envelope=name != "pcm"),
        "encode_cpu": (encoded - began) / seconds,  # share of one core
        "decode_cpu": (decoded - encoded) / seconds,
    }


def _cell(case: Case, variant: str, found: dict[str, float], pcm: dict[str, float], params: dict[str, Value]) -> Cell:
    """One sample: bytes are the same in every run with the same programs."""
    figures: dict[str, Value] = {name: round(value, 4) for name, value in found.items() if name != "wire_kbits"}
    figures["ratio"] = round(found["wire_kbits"] / pcm["wire_kbits"], 4)
    return replace(case, role=variant).cell("wire", "kbit/s", [found["wire_kbits"]], params, **figures)


def likeness(received: Wave, speech: Wave, rate: int, *, by_envelope: bool) -> float:
    """Correlation (-1 to 1) at the delay that gives the highest one."""
    count = min(len(received), len(speech)) - round(_DELAY_S * rate)
    delays = range(0, round(_DELAY_S * rate), max(1, rate // 2000) if by_envelope else 1)
    return max(_correlation(received[delay : delay + count], speech[:count], rate, by_envelope) for delay in delays)


def _correlation(received: Wave, speech: Wave, rate: int, by_envelope: bool) -> float:
    if by_envelope:
        received, speech = _envelope(received, rate), _envelope(speech, rate)
    return float(np.corrcoef(received, speech)[0, 1])


def _envelope(wave: Wave, rate: int) -> Wave:
    step = round(rate * _STEP_S)
    loudness: Wave = np.sqrt((wave[: len(wave) // step * step].reshape(-1, step) ** 2).mean(axis=1))
    return loudness


def prepare(_run: Run) -> None:
    if "opus" not in SOUND_ENCODINGS:
        raise PebbleError("Opus needs PyAV, which is not installed: pip install 'pebble-robot[media]'")


_BUDGET = Budget(6, seconds=10.0, bitrates=BITRATES)

SOUND = Comparison(
    name="sound",
    title="Sound on the wire",
    what="Bytes of each sound encoding with the headers of MQTT, TCP and IP. Nothing is sent: these are the "
    "encoders' bytes for synthetic speech.",
    help="Sound on the wire: bytes of every encoding, with all headers.",
    full=_BUDGET,
    quick=_BUDGET,
    constants={"rate": RATE},
    prepare=prepare,
    measure=measure,
    tables=(
        Grid(
            title=f"Sound of {RATE / 1000:g} kHz mono on the wire, chunks of {_CHUNK_MS} ms",
            rows=("variant", "bitrate", "packet"), heads=("encoding", "", ""),
            columns=(
                single_column("pack./s", "packets_per_s", ".1f"), single_column("payload", "payload_kbits", ".1f"),
                percentile_column(50, "wire"), single_column("× PCM", "ratio", ".3f"),
                single_column("likeness", "likeness", ".3f"), single_column("enc.", "encode_cpu", ".1%"),
                single_column("dec.", "decode_cpu", ".1%"),
            ),
            caption=f"payload, wire: kbit/s, topic {TOPIC}\nenc., dec.: CPU of the encoder and the decoder\n"
            "likeness: correlation of samples (pcm), of envelopes by 20 ms (opus)",
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
)  # fmt: skip
