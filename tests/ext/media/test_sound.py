"""Sound to packets and back: what was said is what is heard, and rubbish is nothing."""

from __future__ import annotations

import random
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from pebble.errors import PayloadError, PebbleError
from pebble.extensions.media import opus, sound
from pebble.extensions.media.opus import milliseconds
from pebble.extensions.media.packets import Sound
from pebble.extensions.media.pcm import Resampler, Samples, remix, to_bytes, to_int16, to_samples
from pebble.extensions.media.sound import (
    SOUND_ENCODINGS,
    ReceivedSound,
    SoundDecoder,
    make_sound_encoder,
    sequence_numbers,
    unpack,
)
from pebble.extensions.media.sound_file import SoundFile
from pebble.extensions.media.speech import Speech
from tests.kit.sound import envelope
from tests.vectors import vectors

VECTORS: list[dict[str, Any]] = vectors("pbat.json")
SECONDS = 4


def speech(rate: int, channels: int = 1) -> Samples:
    return Speech(rate, channels).samples(0, SECONDS * rate)


def packets(name: str, samples: Samples, rate: int, *, feed: int = 320, **options: Any) -> list[bytes]:
    """Encoded in pieces of ``feed`` samples, captured from epoch millisecond 1000 on."""
    encoder = make_sound_encoder(name, rate=rate, channels=samples.shape[1], **options)
    made = []
    for at in range(0, len(samples), feed):
        made += encoder.encode(to_bytes(samples[at : at + feed]), 1000 + round(1000 * at / rate))
    return made


def received(raw: list[bytes]) -> list[ReceivedSound]:
    decoder = SoundDecoder()
    return [one for one in map(decoder.feed, raw) if one is not None]


def joined(sounds: list[ReceivedSound]) -> Samples:
    return np.concatenate([one.samples for one in sounds])


def likeness(heard: Samples, heard_hz: int, said: Samples, said_hz: int) -> float:
    """How alike the loudness of the first channels is."""
    first, second = (envelope(of[:, 0].astype(float), hz) for of, hz in ((heard, heard_hz), (said, said_hz)))
    count = min(len(first), len(second))
    return float(np.corrcoef(first[:count], second[:count])[0, 1])


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["name"])
def test_vectors(vector: dict[str, Any]) -> None:
    one = SoundDecoder().feed(bytes.fromhex(vector["hex"]))
    found = None if one is None else (one.rate, one.channels, one.samples.reshape(-1).tolist())
    expected = None if vector["samples"] is None else (vector["rate"], vector["channels"], vector["samples"])
    assert found == expected


# -- PCM


@pytest.mark.parametrize(("feed", "channels"), [(1, 1), (321, 2), (5000, 1)])
def test_pcm_is_exact_whatever_the_pieces(feed: int, channels: int) -> None:
    recorded = speech(16000, channels)[:8000]
    sounds = received(packets("pcm", recorded, 16000, feed=feed))
    assert [len(one.samples) for one in sounds] == [320] * 25
    assert np.array_equal(joined(sounds), recorded)
    assert b"".join(one.pcm for one in sounds) == recorded.tobytes()
    assert [one.sequence for one in sounds] == list(range(1, 26))
    assert all(abs(one.captured_ms - (1000 + 20 * number)) <= 1 for number, one in enumerate(sounds))


def test_what_the_header_cannot_express_is_resampled() -> None:
    encoder = make_sound_encoder("pcm", rate=96000, channels=2)
    assert encoder.rate == 48000
    (raw,) = encoder.encode(bytes(96000 // 50 * 4), 1000)
    assert (Sound.unpack(raw).rate, Sound.unpack(raw).samples) == (48000, 960)


def test_other_rate_and_channels_than_captured() -> None:
    recorded = speech(48000, 2)
    sounds = received(packets("pcm", recorded, 48000, feed=960, sent_rate=16000, sent_channels=1))
    assert {(one.rate, one.channels, len(one.samples)) for one in sounds} == {(16000, 1, 320)}
    assert likeness(joined(sounds), 16000, recorded, 48000) > 0.98


@pytest.mark.parametrize(("name", "before", "after"), [("pcm", 200, 640), ("opus", 1280, 1920)])
def test_a_hole_in_what_is_captured_is_no_part_of_a_packet_or_bundle(name: str, before: int, after: int) -> None:
    encoder = make_sound_encoder(name, rate=16000, channels=1, bundle=3)
    assert encoder.encode(bytes(before), 1000) == []
    (raw,) = encoder.encode(b"\1" * after, 5000)
    assert (Sound.unpack(raw).captured_ms, Sound.unpack(raw).samples) == (5000, after // 2)


# -- Opus


@pytest.mark.parametrize(("captured", "sent", "channels"), [(16000, 16000, 1), (48000, 48000, 2), (22050, 24000, 1)])
def test_opus_sounds_the_same(captured: int, sent: int, channels: int) -> None:
    recorded = speech(captured, channels)
    sounds = received(packets("opus", recorded, captured, feed=captured // 50))
    assert {(one.rate, one.channels, len(one.samples), one.encoding) for one in sounds} == {
        (sent, channels, sent // 50, "opus")
    }
    assert likeness(joined(sounds), sent, recorded, captured) > 0.9


@pytest.mark.parametrize(("chunk_ms", "part_ms", "bundle"), [(1, 20, 3), (30, 40, 1), (1000, 60, 3)])
def test_bundles(chunk_ms: int, part_ms: int, bundle: int) -> None:
    raw = packets("opus", speech(16000), 16000, chunk_ms=chunk_ms, bundle=bundle)
    unpacked = list(map(unpack, raw))
    assert {one.samples for one in unpacked} == {16 * part_ms * bundle}
    assert {len(opus.split(one.body)) for one in unpacked} == {bundle}
    sounds = received(raw)
    assert len(joined(sounds)) == sum(one.samples for one in unpacked)
    assert all(abs(b.captured_ms - a.captured_ms - part_ms * bundle) <= 1 for a, b in pairwise(sounds))


def test_bitrate_is_as_configured() -> None:
    sizes = {
        bitrate: sum(map(len, packets("opus", speech(16000), 16000, bitrate=bitrate, bundle=3)))
        for bitrate in (16000, 32000)
    }
    assert sizes[16000] * 8 / SECONDS < 18_000
    assert sizes[16000] < sizes[32000] * 8 / 8 < 36_000 / 8 * SECONDS


def test_any_change_in_midstream() -> None:
    numbers = sequence_numbers()
    made = []
    for name, rate, channels in (("pcm", 16000, 1), ("opus", 16000, 1), ("opus", 48000, 2), ("pcm", 44100, 2)):
        made += packets(name, speech(rate, channels)[: rate // 5], rate, feed=rate // 50, numbers=numbers)
    sounds = received(made)
    assert [one.sequence for one in sounds] == list(range(1, 41))
    assert [(one.encoding, one.rate, one.channels) for one in sounds[::10]] == [
        ("pcm", 16000, 1),
        ("opus", 16000, 1),
        ("opus", 48000, 2),
        ("pcm", 44100, 2),
    ]


@pytest.mark.parametrize(
    ("first", "rest", "expected"),
    [(0x00, b"\0", 10), (0x48, b"\0", 20), (0x5B, b"\3", 180), (0x6A, b"\0", 40), (0x80, b"", 2.5), (0xFB, b"", 0)],
)
def test_how_long_an_opus_packet_is(first: int, rest: bytes, expected: float) -> None:
    assert milliseconds(bytes([first]) + rest) == expected


# -- without PyAV, and other mistakes


def test_without_pyav_opus_is_refused_and_pcm_works(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = packets("opus", speech(16000)[:320], 16000)
    monkeypatch.setitem(sys.modules, "av", None)
    monkeypatch.setattr(sound, "SOUND_ENCODINGS", ("pcm",))
    with pytest.raises(PebbleError, match="pip install"):
        make_sound_encoder("opus", rate=16000, channels=1)
    decoder = SoundDecoder()
    assert decoder.feed(raw[0]) is None
    assert decoder.feed(packets("pcm", speech(16000)[:320], 16000)[0]) is not None


def test_an_unknown_encoding_is_named() -> None:
    assert SOUND_ENCODINGS == ("pcm", "opus")
    with pytest.raises(PebbleError, match='"mp3": use pcm or opus'):
        make_sound_encoder("mp3", rate=16000, channels=1)


def test_hostile_bodies_of_opus() -> None:
    randoms = random.Random(6)
    for _ in range(1500):
        body = randoms.randbytes(randoms.randrange(40))
        try:
            parts = opus.split(body)
        except PayloadError:
            continue
        assert opus.join(parts) == body


# -- samples


@pytest.mark.parametrize(("rate", "wanted"), [(48000, 16000), (48000, 48000), (44099, 16000)])
def test_resampling_keeps_a_tone(rate: int, wanted: int) -> None:
    def tone(of: int) -> Any:
        return 10_000 * np.sin(2 * np.pi * 440 * np.arange(of) / of)

    resampler = Resampler(rate, wanted, 1)
    pieces = np.array_split(np.rint(tone(rate)).astype(np.int16)[:, None], 37)
    made = np.concatenate([resampler.feed(piece) for piece in pieces])[:, 0].astype(float)
    assert abs(len(made) - wanted) <= 1
    spectrum = np.abs(np.fft.rfft(made * np.hanning(len(made))))
    peak = int(spectrum.argmax())
    assert abs(peak * wanted / len(made) - 440) < 1
    assert spectrum[peak] ** 2 > 1e4 * (np.sum(spectrum**2) - np.sum(spectrum[peak - 3 : peak + 4] ** 2))


def test_resampling_down_leaves_no_alias() -> None:
    tone = np.rint(10_000 * np.sin(2 * np.pi * 11_000 * np.arange(48000) / 48000)).astype(np.int16)
    made = Resampler(48000, 16000, 1).feed(tone[:, None])
    assert np.abs(made[200:].astype(float)).max() < 40


def test_remixing() -> None:
    stereo = np.array([[100, 300], [-32768, -32768]], np.int16)
    assert remix(stereo, 1).tolist() == [[200], [-32768]]
    assert remix(stereo[:, :1], 2).tolist() == [[100, 100], [-32768, -32768]]
    assert to_samples(b"\1\0\2\0\3\0\4", 2).tolist() == [[1, 2]], "an unfinished sample is left out"
    assert to_int16(np.array([-4e4, -0.6, 4e4])).tolist() == [-32768, -1, 32767], "clipped, never turned over"
    assert make_sound_encoder("opus", rate=16000, channels=6).channels == 1


# -- sound files


SOUND = np.stack([np.arange(-20_000, 20_000, 4), np.arange(20_000, -20_000, -4)], axis=1).astype(np.int16)


def samples(path: Path, rate: int = 8000) -> np.ndarray:
    with SoundFile(path) as file:
        assert file.rate == rate
        return np.frombuffer(b"".join(file.chunks()), "<i2").reshape(-1, file.channels)


def test_flac_is_the_same_and_the_others_as_long(tmp_path: Path) -> None:
    assert np.array_equal(samples(encode(tmp_path / "a.flac", SOUND, 8000)), SOUND)
    assert len(samples(encode(tmp_path / "a.mp3", SOUND, 8000))) == pytest.approx(len(SOUND), abs=3000)
    opus = samples(encode(tmp_path / "a.ogg", SOUND, 48_000), rate=48_000)
    assert len(opus) == pytest.approx(len(SOUND), abs=3000)


@pytest.mark.parametrize("ending", ["mp3", "ogg", "flac"])
@pytest.mark.parametrize("content", [b"", b"#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/a.mp3\n", bytes(3000)])
def test_what_is_no_sound_is_refused(tmp_path: Path, ending: str, content: bytes) -> None:
    path = tmp_path / f"a.{ending}"
    path.write_bytes(content)
    with pytest.raises(PebbleError, match="a"):
        samples(path)


_CODECS = {".mp3": "libmp3lame", ".ogg": "libopus", ".flac": "flac", ".wav": "pcm_s16le"}


def encode(path: Path, samples: Samples, rate: int) -> Path:
    """``samples`` are (samples, channels); one or two channels. Ogg holds Opus, which is decoded at 48 kHz."""
    codec, layout = _CODECS[path.suffix.lower()], "mono" if samples.shape[1] == 1 else "stereo"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, layout=layout)
        stream.format = form = "s16p" if codec == "libmp3lame" else "s16"
        resampler = av.AudioResampler(format=form, layout=layout, rate=rate)
        for start in range(0, len(samples), 1024):
            piece = np.ascontiguousarray(samples[start : start + 1024]).reshape(1, -1)
            frame = av.AudioFrame.from_ndarray(piece, format="s16", layout=layout)
            frame.sample_rate, frame.pts = rate, start
            for made in resampler.resample(frame):
                container.mux(stream.encode(made))
        container.mux(stream.encode(None))
    return path
