"""The soundboard's wire and processes, with a real player at the other end."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pebble.contract import MEDIA_REPORT, codec
from pebble.contract.payloads import MediaReport
from pebble.services.soundboard_handler.service import SoundboardHandler
from pebble.transports import QoS
from tests.ext.soundboard.conftest import Make
from tests.ext.soundboard.soundboard_rig import LONG, Soundboard, tone, write_wav
from tests.support import gone, until

PLAY, STOP = ["play", "start", "on", "enable", "enabled"], ["stop", "off", "disable", "disabled"]


def test_a_clip_is_listed_played_as_it_is_and_over(
    both: Soundboard, record_property: Callable[[str, object], None]
) -> None:
    path = write_wav(both.sounds / "intro.wav", tone(0.4, 2))
    write_wav(both.sounds / "warn" / "Alarm.WAV", tone(0.1))
    (both.sounds / "notes.txt").write_text("no sound")
    both.start()
    assert both.files == ["intro.wav", "warn/Alarm.WAV"]
    assert both.catalogues[-1].keys() == {"files", "controls", "timestamp"}
    assert both.statuses[-1] | {"timestamp": 0} == {
        "playing": False, "file": None, "error": None, "controls": True, "timestamp": 0
    }  # fmt: skip
    began_ns = time.monotonic_ns()
    both.play("intro.wav")
    assert both.became(playing=True, file="intro.wav", error=None)
    playing_ms = (time.monotonic_ns() - began_ns) / 1e6
    assert both.became(playing=False, file=None, error=None)
    (played,) = both.played
    record_property("ms until playing, until the first sample", (playing_ms, (played.began_ns - began_ns) / 1e6))
    assert playing_ms < 3000, "0.3 s on a machine that is not busy"
    assert played.file == str(path), "called with the path, as aplay is"
    assert np.array_equal(both.samples(), tone(0.4, 2))
    both.play("warn\\Alarm.WAV")
    assert both.became(playing=True, file="warn/Alarm.WAV")


def test_a_clip_is_played_by_a_name_that_looks_the_same(both: Soundboard) -> None:
    write_wav(both.sounds / "ba\u0308r.wav", tone(2.0))
    both.start()
    both.play("b\u00e4r.wav")
    assert both.became(playing=True, file="ba\u0308r.wav", error=None)


def test_every_form_of_the_command(make: Make) -> None:
    board = make(player_command=LONG, clip=0.1)
    plays: list[Any] = [{"action": word.upper(), "file": "a.wav"} for word in PLAY]
    plays += [{"value": {"action": "Play", "file": "a.wav"}}, {"value": True, "file": "a.wav"}]
    plays += [{"enabled": True, "file": "a.wav"}, {"action": "unknown", "enabled": True, "file": "a.wav"}]
    stops: list[Any] = [{"action": word.title(), "enabled": True} for word in STOP]
    stops += [False, {"value": False}, {"enabled": False}, {"value": {"action": "stop"}}]
    stops += [{"action": "", "enabled": False}]
    for play, stop in islice(zip(cycle(plays), cycle(stops), strict=False), max(len(plays), len(stops))):
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
    """The files inside are those of test_clips.py."""
    outside = write_wav(board.folder / "outside.wav", tone(0.1))
    board.with_clip("inside.wav", 0.1)
    names = ["../outside.wav", str(outside), "..\\outside.wav", "no.wav", "a" * 300 + ".wav", "zero\0.wav"]
    for name in names:
        assert board.refused({"action": "play", "file": name}) == f"Sound file not found: {name[:300]}"
    for nothing in ("", "  ", None):
        assert board.refused({"action": "play", "file": nothing}) == "Play command missing file"
    assert board.played == []


@pytest.mark.parametrize("more", [{}, {"repeat": True}])
def test_what_goes_wrong_with_a_player_is_reported_and_not_repeated(board: Soundboard, more: dict[str, Any]) -> None:
    (board.sounds / "bad.wav").write_bytes(b"no sound")
    board.with_clip("good.wav", 0.1).play("bad.wav", **more)
    assert board.became(playing=False, error="player exited with code 1")
    assert board.players() == []
    board.play(" good.wav ")  # blanks are left out
    assert board.became(playing=True, file="good.wav", error=None), "the next command clears the error"


def test_a_player_that_is_missing_is_reported_and_an_unchanged_list_is_not_published_again(make: Make) -> None:
    board = make(player_command=["no-such-player"], clip=0.1)
    board.play("a.wav")
    error = "Failed to start playback: [Errno 2] No such file or directory: 'no-such-player'"
    assert board.became(playing=False, error=error)
    service, published = SoundboardHandler(board.config, board.world.transport), list[Any]()
    service.publish = lambda _channel, value: bool(published.append(value))  # type: ignore[method-assign]
    service.scan()
    service.scan()
    assert [one.files for one in published] == [["a.wav"]]


def test_a_new_clip_replaces_the_one_before(board: Soundboard) -> None:
    for name in ("a", "b", "c"):
        write_wav(board.sounds / f"{name}.wav", tone(30))
    board.start()
    board.play("a.wav")
    assert until(lambda: len(board.played) == 1)
    board.play("b.wav")
    board.play("c.wav")
    assert board.became(playing=True, file="c.wav", error=None)
    assert until(lambda: len(board.played) >= 2)
    first, last = board.played[0], board.played[-1]
    assert first.stopped
    assert first.ended_ns is not None
    assert first.ended_ns < board.played[1].began_ns, "never two at a time"
    assert (Path(last.file).name, last.ended_ns) == ("c.wav", None)
    assert [status["file"] for status in board.statuses][:2] == [None, "a.wav"]
    assert [status["playing"] for status in board.statuses].count(False) == 1, "only before the first"


def test_a_new_player_waits_for_the_end_of_the_one_before(make: Make, tmp_path: Path) -> None:
    log = tmp_path / "log"
    slow = f"echo begin >> {log}; trap 'sleep 0.2; echo end >> {log}; exit 7' TERM; while :; do sleep 0.01; done"
    board = make(player_command=["sh", "-c", slow])
    board.with_clip("a.wav", 0.1)
    for number in range(3):
        board.play("a.wav")
        assert until(lambda count=number: log.exists() and log.read_text().count("begin") == count + 1)
    board.send({"action": "stop"})
    assert board.became(playing=False, file=None, error=None), "how a stopped player exits is no error"
    assert log.read_text() == "begin\nend\n" * 3
    assert board.refused({"action": "stop"}) is None, "there is nothing to stop"


def test_what_a_player_leaves_behind_ends_with_it(make: Make, tmp_path: Path) -> None:
    child = tmp_path / "child"
    board = make(player_command=["sh", "-c", f"sleep 60 & echo $! > {child}.new; mv {child}.new {child}"])
    board.with_clip("a.wav", 0.1).play("a.wav")
    assert until(child.exists)
    assert until(lambda: gone(int(child.read_text())))
    assert board.became(playing=False, error=None)


def test_a_player_that_ignores_the_stop_is_killed_with_what_it_started(make: Make, tmp_path: Path) -> None:
    child = tmp_path / "child"
    deaf = f"trap '' TERM; sleep 60 & echo $! > {child}; while :; do sleep 0.02; done"
    board = make(player_command=["sh", "-c", deaf])
    board.with_clip("a.wav", 0.1).play("a.wav")
    assert until(lambda: child.exists() and child.read_text().endswith("\n"))
    board.send(False)
    assert board.became(playing=False, error=None)
    assert until(lambda: gone(int(child.read_text())))


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
    board.play("a.wav", repeat=3)
    assert board.became(playing=True)
    assert board.became(playing=False, error=None)
    assert len(board.played) == 3
    assert sum(status["playing"] for status in board.statuses) == 1
    board.play("a.wav", repeat=True)
    assert until(lambda: len(board.played) >= 5)
    board.send(False)
    assert board.became(playing=False, error=None)
    count = len(board.played)
    assert board.refused(True) == "Play command missing file"
    assert len(board.played) == count


def test_the_list_follows_the_folder(board: Soundboard) -> None:
    board.sounds.rmdir()
    board.start()
    assert board.files == []
    write_wav(board.sounds / "new.wav", tone(0.1))
    assert until(lambda: board.files == ["new.wav"], 15), "after one scan"
    (board.sounds / "new.wav").unlink()
    assert board.refused({"action": "play", "file": "new.wav"}) == "Sound file not found: new.wav", (
        "still listed or not"
    )
    assert until(lambda: board.files == [], 15)
    assert len({one["timestamp"] for one in board.catalogues}) == 3, "made when it changes"


@pytest.mark.parametrize(
    ("doing", "error"),
    [
        ("plays 16 kHz, 1 channel", "the loudspeaker is busy (talk-back plays)"),
        ("is silent", "player exited with code 1"),
    ],
)
def test_a_loudspeaker_that_talk_back_has_is_busy(make: Make, doing: str, error: str) -> None:
    board = make(exclusive=True)
    path = write_wav(board.sounds / "a.wav", tone(60))
    board.start()
    talk_back = board.hold_loudspeaker(path)
    report = codec.encode(MEDIA_REPORT, MediaReport(running=True, doing=doing))
    board.world.transport.publish(f"{board.world.base}/outgoing/media-report/audio_receiver", report, qos=QoS.DELIVERED)
    board.play("a.wav")
    assert board.became(playing=False, file=None, error=error)
    talk_back.kill()
    talk_back.wait(10)
    board.play("a.wav")
    assert until(lambda: len(board.played) == 2), "nothing waits for it, and nothing remembers it"
