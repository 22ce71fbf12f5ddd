"""Measures bytes of sound on the wire: Opus against the original's PCM, with headers of MQTT, TCP and IP."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from pebble.bench import output
from pebble.bench.results import Cell, Stopwatch
from pebble.bench.tables import plain_table
from pebble.contract import AUDIO
from pebble.errors import PebbleError
from pebble.media.opus import BUNDLE_LIMIT
from pebble.media.pcm import to_bytes
from pebble.media.sound import SOUND_ENCODINGS, SoundDecoder, make_sound_encoder
from pebble.media.speech import Speech

TOPIC = AUDIO.topic("pebble/robots/goob")
AIM = 0.16  # of PCM's bytes
_IP, _TCP = 20, 32  # bytes; version 4 without options, TCP with time stamps as Linux sends them
_CHUNK_MS = 20
_DELAY_S = 0.02  # at most, of codec and resampler
_STEP_S = 0.02  # of an envelope
_FIGURES = ("packets_per_s", "payload_kbits", "ratio", "likeness", "encode_cpu", "decode_cpu")

Wave = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One encoding of the same sound. ``likeness``: of the samples for PCM, of the envelopes for Opus."""

    encoding: str
    bitrate: int | None
    bundle: int
    packets_per_s: float
    payload_kbits: float
    wire_kbits: float
    ratio: float  # of PCM's bytes on the wire
    likeness: float
    encode_cpu: float  # share of one core
    decode_cpu: float


def wire_bytes(payload: int, topic: str = TOPIC) -> int:
    """Size of one PUBLISH with QoS 0 in a TCP segment of its own (MQTT 3.1.1, 3.3)."""
    length = 2 + len(topic.encode()) + payload
    digits = max(1, (length.bit_length() + 6) // 7)  # of the remaining length
    return _IP + _TCP + 1 + digits + length


def run(
    folder: Path = output.FOLDER,
    seconds: float = 10.0,
    *,
    rate: int = 16_000,
    bitrates: Sequence[int] = (16_000, 24_000, 32_000),
    console: Console | None = None,
) -> int:
    """Measures, prints and writes; returns 0. Raises PebbleError without PyAV."""
    if "opus" not in SOUND_ENCODINGS:
        raise PebbleError("Opus needs PyAV, which is not installed: pip install 'pebble-robot[media]'")
    if seconds < 1:
        raise PebbleError("seconds must be at least 1")
    console = console or Console()
    output.check_folder(folder)
    watch = Stopwatch("sound", ["pebble", "bench", "sound"], {"seconds": seconds, "rate": rate})
    rows = list(measure(seconds, rate, bitrates))
    console.print(table(rows, rate))
    most = max(row.ratio for row in rows if row.encoding == "opus" and row.bundle > 1)
    met = "met" if most <= AIM else "missed"
    assessment = [f"aim: Opus with several parts in a packet takes at most {AIM} of PCM's bytes: {met} ({most:.3f})"]
    output.finish(watch.results([_cell(row) for row in rows], assessment), folder, console)
    return 0


def measure(seconds: float, rate: int, bitrates: Sequence[int]) -> Iterator[Row]:
    """One row per encoding; PCM comes first, as the reference of the others."""
    speech = Speech(rate).samples(0, round(seconds * rate))
    pcm, pcm_bytes = _row("pcm", speech, rate, None, 1, None)
    yield pcm
    for bitrate in bitrates:
        for bundle in range(1, BUNDLE_LIMIT + 1):
            yield _row("opus", speech, rate, bitrate, bundle, pcm_bytes)[0]


def _row(
    name: str, speech: npt.NDArray[np.int16], rate: int, bitrate: int | None, bundle: int, pcm_rate: float | None
) -> tuple[Row, float]:
    """The row, and the bytes on the wire for a second of sound."""
    encoder = make_sound_encoder(
        name, rate=rate, channels=1, chunk_ms=_CHUNK_MS, bitrate=bitrate or 24_000, bundle=bundle
    )
    size = rate * _CHUNK_MS // 1000
    began = time.process_time()
    packets = []
    for at in range(0, len(speech), size):
        packets += encoder.encode(to_bytes(speech[at : at + size]), round(1000 * at / rate))
    encoded = time.process_time()
    decoder = SoundDecoder()
    received = [one.samples for one in map(decoder.feed, packets) if one is not None]
    decoded = time.process_time()
    sound = np.concatenate(received)[:, 0].astype(np.float64)
    seconds = len(sound) / encoder.rate
    wire = sum(wire_bytes(len(packet)) for packet in packets) / seconds
    row = Row(
        encoding=name,
        bitrate=bitrate,
        bundle=bundle,
        packets_per_s=len(packets) / seconds,
        payload_kbits=sum(map(len, packets)) * 8 / 1000 / seconds,
        wire_kbits=wire * 8 / 1000,
        ratio=1.0 if pcm_rate is None else wire / pcm_rate,
        likeness=likeness(sound, speech[:, 0].astype(np.float64), rate, by_envelope=name != "pcm"),
        encode_cpu=(encoded - began) / seconds,
        decode_cpu=(decoded - encoded) / seconds,
    )
    return row, wire


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


def table(rows: Sequence[Row], rate: int) -> Table:
    title = f"Sound of {rate / 1000:g} kHz mono on the wire, chunks of {_CHUNK_MS} ms"
    heads = ("encoding", "parts", "packets/s", "payload", "wire", "× PCM", "likeness", "CPU %")
    shown = plain_table(title, heads)
    for row in rows:
        shown.add_row(
            row.encoding + (f" {row.bitrate // 1000} kbit/s" if row.bitrate else ""),
            str(row.bundle),
            f"{row.packets_per_s:.1f}",
            f"{row.payload_kbits:.1f}",
            f"{row.wire_kbits:.1f}",
            f"{row.ratio:.3f}",
            f"{row.likeness:.3f}",
            f"{100 * row.encode_cpu:.1f} / {100 * row.decode_cpu:.1f}",
        )
    shown.caption = (
        f"payload, wire: kbit/s, topic {TOPIC}\nCPU: encoder / decoder\n"
        "likeness: correlation of samples (pcm), of envelopes by 20 ms (opus)"
    )
    shown.caption_justify = "left"
    return shown


def _cell(row: Row) -> Cell:
    """One sample per cell: bytes are the same in every run with the same programs."""
    parts = "1 part" if row.bundle == 1 else f"{row.bundle} parts"
    figures = asdict(row)
    return Cell(
        variant=figures.pop("encoding"),
        params={"bitrate": f"{row.bitrate // 1000} kbit/s", "packet": parts} if row.bitrate else {},
        measure="wire",
        unit="kbit/s",
        rounds=[[figures.pop("wire_kbits")]],
        figures={name: round(figures[name], 4) for name in _FIGURES},
    )
