"""The soundboard as a process of its own, with a simulated loudspeaker, and a client that commands it."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self
from unicodedata import normalize

import numpy as np
import pytest

from pebble.contract import MEDIA_REPORT, codec
from pebble.contract.payloads import MediaReport, SoundboardFiles
from pebble.errors import PebbleError
from pebble.extensions.lab.simulation.loudspeaker import Playback, playbacks
from pebble.extensions.media.pcm import Samples
from pebble.services.soundboard_handler.clips import Clips
from pebble.services.soundboard_handler.service import SoundboardHandler
from pebble.transports import QoS
from tests.ext.media.test_sound import encode
from tests.kit.robot import Program, ProgramRobot
from tests.support import WAIT_S, Broker, gone, until

RATE = 16_000
RAW = ["-q", "-t", "raw", "-f", "S16_LE", "-c", "{channels}", "-r", "{rate}", "-D", "{device}", "-"]


def tone(seconds: float, channels: int = 1, rate: int = RATE) -> Samples:
    """(samples, channels); each channel another tone."""
    times = np.arange(round(seconds * rate)) / rate
    tones = [9000 * np.sin(2 * np.pi * (440 + 220 * channel) * times) for channel in range(channels)]
    return np.stack(tones, axis=1).astype(np.int16)


def write_wav(path: Path, samples: Samples, rate: int = RATE) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return encode(path, samples, rate)


class Soundboard(ProgramRobot):
    """``playback`` are keys of services.soundboard_handler.playback; the player records unless they name another."""

    process: Program

    def __init__(self, kind: str, port: int, **playback: Any) -> None:
        super().__init__(kind, port, {})
        self.sounds, self.record = self.folder / "sounds", self.folder / "played"
        self.sounds.mkdir()
        self.player = [sys.executable, "-m", "pebble.simulation.loudspeaker", "--record", str(self.record)]
        options = {"directory": str(self.sounds), "player_command": self.player, **playback}
        self.raw["services"] = {
            "mqtt_bridge": {"media": {"audio_receiver": {"command": [*self.player, *RAW]}}},
            "soundboard_handler": {"enabled": True, "playback": options},
        }
        self.config = self.write()

    def start(self) -> Self:
        """Start the service; returns once it has published what it is doing."""
        count = len(self.statuses), len(self.catalogues)
        self.process = self.run("pebble.services.soundboard_handler.service:SoundboardHandler")
        assert until(lambda: len(self.statuses) > count[0] and len(self.catalogues) > count[1])
        return self

    def with_clip(self, name: str, seconds: float) -> Self:
        """Put a tone into the folder, and start the service."""
        write_wav(self.sounds / name, tone(seconds))
        return self.start()

    def send(self, body: Any) -> None:
        self.world.command("soundboard-command", body)

    def play(self, file: str, **more: Any) -> None:
        self.send({"action": "play", "file": file, **more})

    def became(self, timeout: float = WAIT_S, **expected: Any) -> bool:
        """Wait until the newest status has these values."""
        return self.world.became("soundboard-status", timeout, **expected)

    def plays(self, file: str, **more: Any) -> bool:
        """Play a clip, and wait until it is over without an error."""
        self.play(file, **more)
        return self.became(playing=True, file=file, error=None) and self.became(playing=False, file=None, error=None)

    def refused(self, body: Any) -> str | None:
        """Send it to a soundboard that plays nothing; the error that it publishes."""
        count = len(self.statuses)
        self.send(body)
        assert until(lambda: len(self.statuses) > count), body
        assert not self.statuses[-1]["playing"], body
        error: str | None = self.statuses[-1]["error"]
        return error

    @property
    def statuses(self) -> list[dict[str, Any]]:
        return self.world.payloads("soundboard-status")

    @property
    def catalogues(self) -> list[dict[str, Any]]:
        return self.world.payloads("soundboard-files")

    @property
    def played(self) -> list[Playback]:
        return playbacks(self.record)

    def samples(self, number: int = 0) -> Samples:
        one = self.played[number]
        return np.frombuffer(one.frames(), "<i2").reshape(-1, one.channels)

    def players(self) -> list[int]:
        """The processes that this service has started and that run."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        return [int(word) for word in children]


Make = Callable[..., Soundboard]


@pytest.fixture
def make(local: Broker) -> Iterator[Make]:
    """Makes one with these options."""
    with ExitStack() as ends:
        yield lambda kind="mqtt", **options: ends.enter_context(Soundboard(kind, local.port, **options))


@pytest.fixture
def board(make: Make) -> Soundboard:
    return make()


PLAY, STOP = ["play", "start", "on", "enable", "enabled"], ["stop", "off", "disable", "disabled"]


@pytest.mark.parametrize("kind", ["mqtt", "zenoh"])
def test_a_clip_is_listed_played_as_it_is_and_over(make: Make, kind: str) -> None:
    both = make(kind)
    path = write_wav(both.sounds / "intro.wav", tone(0.4, 2))
    write_wav(both.sounds / "warn" / "ba\u0308r.WAV", tone(0.1))
    (both.sounds / "notes.txt").write_text("no sound")
    both.start()
    assert both.catalogues[-1]["files"] == ["intro.wav", "warn/ba\u0308r.WAV"]
    assert both.catalogues[-1].keys() == {"files", "controls", "timestamp"}
    assert both.statuses[-1] | {"timestamp": 0} == {
        "playing": False, "file": None, "error": None, "controls": True, "timestamp": 0
    }  # fmt: skip
    assert both.plays("intro.wav")
    (played,) = both.played
    assert played.file == str(path), "called with the path, as aplay is"
    assert np.array_equal(both.samples(), tone(0.4, 2))
    both.play("warn\\b\u00e4r.WAV")
    assert both.became(playing=True, file="warn/ba\u0308r.WAV"), "a name that looks the same"


def test_what_plays_and_what_stops(make: Make) -> None:
    """The forms of commands are decoded in tests/contract/test_codec.py."""
    board = make(player_command=["sh", "-c", "exec sleep 60"]).with_clip("a.wav", 0.1)
    plays: list[Any] = [{"action": word.upper(), "file": "a.wav"} for word in PLAY]
    plays += [{"action": "unknown", "enabled": True, "file": "a.wav"}]
    stops: list[Any] = [{"action": word.title(), "enabled": True} for word in STOP]
    stops += [{"action": "", "enabled": False}, {"enabled": False}]
    for play, stop in zip(plays, stops, strict=True):
        board.send(play)
        assert board.became(playing=True, file="a.wav", error=None), play
        board.send(stop)
        assert board.became(playing=False, file=None, error=None), stop
    count = len(board.statuses)
    board.send({"action": "unknown", "file": "a.wav"})
    board.send({"file": "a.wav"})
    assert board.refused(True) == "Play command missing file"
    assert len(board.statuses) == count + 1, "what neither plays nor stops only is logged"


def test_files_that_are_not_there_or_not_inside(board: Soundboard) -> None:
    outside = write_wav(board.folder / "outside.wav", tone(0.1))
    board.with_clip("inside.wav", 0.1)
    for name in (str(outside), "..\\outside.wav", "a" * 300 + ".wav"):
        assert board.refused({"action": "play", "file": name}) == f"Sound file not found: {name[:300]}"
    assert board.refused({"action": "play", "file": "  "}) == "Play command missing file"
    assert board.played == []


def test_what_goes_wrong_with_a_player_is_reported_and_not_repeated(board: Soundboard) -> None:
    (board.sounds / "bad.wav").write_bytes(b"no sound")
    board.with_clip("good.wav", 0.1).play("bad.wav", repeat=True)
    assert board.became(playing=False, error="player exited with code 1")
    assert board.players() == []
    board.play(" good.wav ")  # blanks are left out
    assert board.became(playing=True, file="good.wav", error=None), "the next command clears the error"


def test_the_list_follows_the_folder_and_an_unchanged_one_is_not_published_again(board: Soundboard) -> None:
    now, published = [0.0], list[Any]()
    service = SoundboardHandler(board.config, board.world.transport, clock=lambda: now[0])
    service.publish = lambda _channel, value: bool(published.append(value))  # type: ignore[method-assign]
    board.sounds.rmdir()
    service.start()
    clip = board.sounds / "a.wav"
    for change in (lambda: None, lambda: write_wav(clip, tone(0.1)), lambda: None, clip.unlink):
        change()
        service.timers.run_due(now[0])
        now[0] += 10.0
    assert [value.files for value in published if isinstance(value, SoundboardFiles)] == [[], ["a.wav"], []]


def test_a_new_clip_replaces_the_one_before_and_waits_for_its_end(make: Make, tmp_path: Path) -> None:
    log = tmp_path / "log"
    slow = f"echo begin >> {log}; trap 'sleep 0.2; echo end >> {log}; exit 7' TERM; while :; do sleep 0.01; done"
    board = make(player_command=["sh", "-c", slow])
    for name in ("b", "c"):
        write_wav(board.sounds / f"{name}.wav", tone(0.1))
    board.with_clip("a.wav", 0.1).play("a.wav")
    assert until(lambda: log.exists() and log.read_text() == "begin\n")
    board.play("b.wav")
    board.play("c.wav")
    assert board.became(playing=True, file="c.wav", error=None), "how a stopped player exits is no error"
    assert until(lambda: log.read_text() == "begin\nend\nbegin\n"), "b was replaced before it began"
    assert [status["playing"] for status in board.statuses].count(False) == 1, "only before the first"
    board.send({"action": "stop"})
    assert board.became(playing=False, file=None, error=None)
    assert board.refused({"action": "stop"}) is None, "there is nothing to stop"


def test_a_player_that_ignores_the_stop_is_killed(make: Make) -> None:
    board = make(player_command=["sh", "-c", "trap '' TERM; while :; do sleep 0.02; done"])
    board.with_clip("a.wav", 0.1).play("a.wav")
    assert board.became(playing=True)
    (player,) = board.players()
    board.send(False)
    assert board.became(playing=False, error=None)
    assert gone(player)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_service_that_ends_leaves_no_player(board: Soundboard, number: int) -> None:
    board.with_clip("a.wav", 60).play("a.wav")
    assert until(lambda: len(board.played) == 1)
    (player,) = board.players()
    assert player == board.played[0].pid == os.getpgid(player), "a group of its own"
    assert board.process.end(number) == (0 if number == signal.SIGTERM else -number)
    assert until(lambda: gone(player))
    assert number == signal.SIGKILL or board.became(playing=False, file=None, error=None), "it is reported"


def test_a_clip_is_repeated(board: Soundboard) -> None:
    board.with_clip("a.wav", 0.1)
    board.play("a.wav", repeat=2)
    assert board.became(playing=True)
    assert board.became(playing=False, error=None)
    assert len(board.played) == 2
    assert sum(status["playing"] for status in board.statuses) == 1
    board.play("a.wav", repeat=True)
    assert until(lambda: len(board.played) >= 4)
    board.send(False)
    assert board.became(playing=False, error=None)


@pytest.mark.parametrize(
    ("doing", "error"),
    [
        ("plays 16 kHz, 1 channel", "the loudspeaker is busy (talk-back plays)"),
        ("is silent", "player exited with code 1"),
    ],
)
def test_a_loudspeaker_that_talk_back_has_is_busy(make: Make, doing: str, error: str) -> None:
    """Its player fails at once; on a busy machine not each time."""
    board = make(player_command=["sh", "-c", "exit 1"]).with_clip("a.wav", 0.1)
    report = codec.encode(MEDIA_REPORT, MediaReport(running=True, doing=doing))
    topic = f"{board.world.base}/outgoing/media-report/audio_receiver"

    def fails() -> bool:
        board.world.transport.publish(topic, report, qos=QoS.DELIVERED)
        board.play("a.wav")
        return board.became(3.0, playing=False, file=None, error=error)

    assert until(fails)


def test_other_formats_are_decoded_and_played(board: Soundboard) -> None:
    """What can be decoded is in tests/ext/media/test_sound.py."""
    sound = tone(0.5, 2, 48_000)
    encode(board.sounds / "tone.flac", sound, 48_000)
    (board.sounds / "bad.ogg").write_bytes(b"no sound " * 100)
    board.start()
    assert board.plays("tone.flac")
    assert [(playback.file, playback.rate, playback.channels) for playback in board.played] == [("-", 48_000, 2)]
    assert np.array_equal(board.samples(), sound)
    board.play("bad.ogg")
    assert until(lambda: board.statuses[-1]["error"])
    assert board.statuses[-1]["error"].startswith("Failed to start playback: bad.ogg cannot be decoded: ")
    assert not board.statuses[-1]["playing"]


# -- the folder of clips


def put(folder: Path, *names: str) -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_everything_that_is_listed_is_found(tmp_path: Path) -> None:
    put(tmp_path, "a b.wav", "~.wav", "~nobody.wav", "ä ö\u00a0ü.wav", "line\nbreak.wav", "d/e/f.wav", "x.mp3", "y.ogg")
    (tmp_path / "link.wav").symlink_to("d/e/f.wav")
    clips = Clips(tmp_path)
    found = {name: clips.find(name) for name in clips.scan()}
    assert len(found) == 9
    assert all(clip is not None for clip in found.values())
    assert {name: clip.name for name, clip in found.items() if clip and clip.name != name} == {"link.wav": "d/e/f.wav"}


def test_what_leads_outside_is_neither_listed_nor_found(tmp_path: Path) -> None:
    inside, outside = tmp_path / "sounds", tmp_path / "sounds-other"
    put(inside, "a.wav", "text.txt")
    put(outside, "b.wav")
    (inside / "b.wav").symlink_to(outside / "b.wav")
    (inside / "other").symlink_to(outside)
    (inside / "circle.wav").symlink_to("circle.wav")
    (inside / "folder.wav").mkdir()
    clips = Clips(inside)
    assert clips.scan() == ["a.wav"]
    names = ["b.wav", "other/b.wav", "../sounds-other/b.wav", "a.wav/../../sounds-other/b.wav", str(outside / "b.wav")]
    for name in (*names, "circle.wav", "folder.wav", "text.txt", "~nobody/a.wav"):
        assert clips.find(name) is None, name


def test_the_folder_may_be_a_link_and_a_name_a_way_around(tmp_path: Path) -> None:
    bear, long = "sub/ba\u0308r.wav", 80 * "\ud55c" + ".wav"  # three times as long in its other form
    put(tmp_path / "real", "a.wav", bear, long, "\u00c5.wav", "A\u030a.wav")
    (tmp_path / "link").symlink_to("real")
    clips = Clips(tmp_path / "link")
    assert clips.scan() == ["a.wav", "A\u030a.wav", bear, "\u00c5.wav", long]
    names = {
        str(tmp_path / "link" / "a.wav"): "a.wav",
        "sub\\../a.wav": "a.wav",
        "sub\\b\u00e4r.wav": bear,
        str(tmp_path / "link" / "sub/b\u00e4r.wav"): bear,
        normalize("NFD", long): long,
        "A\u030a.wav": "A\u030a.wav",
    }
    for name, expected in names.items():
        clip = clips.find(name)
        assert (name, clip and clip.name) == (name, expected)
    with pytest.raises(PebbleError, match="2 names look like this"):
        clips.find("\u212b.wav")


def test_the_list_is_bounded_and_what_is_not_listed_can_be_played(tmp_path: Path) -> None:
    for number in range(1_400):
        os.close(os.open(f"{tmp_path}/{number:04}{'s' * 192}.wav", os.O_CREAT | os.O_WRONLY))
    clips = Clips(tmp_path)
    assert len(clips.scan()) == 256 * 1024 // 200
    assert clips.problem == "only the first 1310 of 1400 are listed"
    assert clips.find(f"1399{'s' * 192}.wav")


def test_what_cannot_be_read_or_named_is_left_out_and_reported(tmp_path: Path) -> None:
    missing = Clips(tmp_path / "missing")
    assert missing.scan() == []
    assert missing.problem == f"{tmp_path}/missing cannot be read: No such file or directory"
    (tmp_path / "circle").symlink_to("circle")
    circle = Clips(tmp_path / "circle")
    assert (circle.scan(), circle.find("good.wav")) == ([], None)
    assert circle.problem == f"{tmp_path}/circle cannot be read: Too many levels of symbolic links"
    assert missing.find("a.wav") is None
    put(tmp_path, "good.wav", "back\\slash.wav")
    clips = Clips(tmp_path)
    assert clips.scan() == ["good.wav"]
    assert clips.problem == "'back\\\\slash.wav' cannot be named in commands: rename it"
    (tmp_path / "back\\slash.wav").unlink()
    latin = Path(os.fsdecode(os.fsencode(tmp_path) + b"/latin\xe4.wav"))
    latin.touch()
    (tmp_path / "link.wav").symlink_to(latin)
    assert clips.scan() == ["good.wav", "link.wav"]
    link = clips.find("link.wav")
    assert link is not None
    assert (link.name, link.path.name) == ("link.wav", "latin\udce4.wav")
    latin.unlink()
    assert (clips.scan(), clips.problem) == (["good.wav"], "")


def test_names_are_sorted_without_regard_to_case_and_are_those_of_what_can_be_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(tmp_path, "b.wav", "A.WAV", "c/B.wav", "C.wav", "a.txt", ".wav.bak", "d.mp3", "e.OGG", "f.flac", "g.m3u")
    assert Clips(tmp_path).scan() == ["A.WAV", "b.wav", "C.wav", "c/B.wav", "d.mp3", "e.OGG", "f.flac"]
    monkeypatch.setattr("pebble.extensions.media.pyav.find_spec", lambda _name: None)
    clips = Clips(tmp_path)
    assert clips.scan() == ["A.WAV", "b.wav", "C.wav", "c/B.wav"]
    assert clips.find("d.mp3") is None
