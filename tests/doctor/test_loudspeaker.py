"""The loudspeaker is checked by playing silence on it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from pebble.check_result import CheckResult, State
from pebble.config import parse
from pebble.doctor.loudspeaker import SILENCE_S, loudspeaker
from pebble.simulation.loudspeaker import playbacks

LOUDSPEAKER = [sys.executable, "-m", "pebble.simulation.loudspeaker"]
RAW = ["-t", "raw", "-f", "S16_LE", "-c", "{channels}", "-r", "{rate}", "-"]


def check(
    player: Sequence[str], *, sounds: bool = True, voice: bool = False, seconds: float = 0.05
) -> list[CheckResult]:
    services: dict[str, Any] = {
        "soundboard_handler": {"enabled": sounds, "playback": {"player_command": list(player)}},
        "av_daemon": {"enabled": voice},
        "mqtt_bridge": {"media": {"audio_receiver": {"command": [*player, *RAW]}}},
    }
    config = parse({"robot": {"id": "rover"}, "services": services}, folder=Path.cwd(), env={})
    return list(loudspeaker(config, seconds))


def test_a_robot_that_plays_nothing_needs_none() -> None:
    assert check(LOUDSPEAKER, sounds=False) == []


@pytest.mark.parametrize(("sounds", "voice"), [(True, False), (True, True), (False, True)])
def test_a_loudspeaker_that_mixes(tmp_path: Path, sounds: bool, voice: bool) -> None:
    (finding,) = check([*LOUDSPEAKER, "--record", str(tmp_path)], sounds=sounds, voice=voice, seconds=SILENCE_S)
    assert finding.state is State.OK
    assert "for two programs at the same time" in finding.text
    assert [one.seconds for one in playbacks(tmp_path)] == [SILENCE_S] * 2
    assert {one.file == "-" for one in playbacks(tmp_path)} == {not sounds}
    assert not any(playbacks(tmp_path)[0].frames())


def test_a_loudspeaker_for_one_program(tmp_path: Path) -> None:
    player = [*LOUDSPEAKER, "--exclusive", "--record", str(tmp_path)]
    (finding,) = check(player, voice=True, seconds=1.5)
    assert finding.state is State.WARN
    assert "plays for one program at a time (loudspeaker: audio open error: Device or resource busy)" in finding.text
    assert "dmix" in finding.fix


@pytest.mark.parametrize(
    ("player", "text", "fix"),
    [
        (["aplay"], "aplay is not installed: nothing can be played", "sudo apt install alsa-utils"),
        (["/no/such/player"], "/no/such/player cannot be started: [Errno 2]", "correct the player's command"),
        (["sh", "-c", "echo no card found >&2; exit 1"], "sh cannot play: no card found", "aplay -l"),
        (["sh", "-c", "exit 3"], "sh cannot play: exit code 3", "aplay -l"),
    ],
)
def test_a_player_that_does_not_play(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, player: list[str], text: str, fix: str
) -> None:
    (tmp_path / "sh").symlink_to("/bin/sh")
    (tmp_path / "setpriv").symlink_to("/usr/bin/setpriv")
    monkeypatch.setenv("PATH", str(tmp_path))
    (finding,) = check(player)
    assert finding.state is State.WARN
    assert text in finding.text
    assert fix in finding.fix


def test_a_player_that_does_not_end_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pebble.doctor.loudspeaker._END_S", 0.2)
    (finding,) = check(["sh", "-c", "exec sleep 60"])
    assert (finding.state, "sh cannot play: did not end within 0.25 s" in finding.text) == (State.WARN, True)
