"""Checks of camera, microphone and loudspeaker."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pebble.checks.check import State
from pebble.checks.media import camera, cameras, loudspeaker, microphone
from pebble.config import Config, parse


def config_of(devices: dict[str, Any]) -> Config:
    return parse({"robot": {"id": "rover"}, "services": {"av_daemon": devices}}, folder=Path.cwd(), env={})


Programs = Callable[..., None]


@pytest.fixture
def only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Programs:
    """Make the machine one that has these programs, and no others."""

    def installs(*names: str) -> None:
        monkeypatch.setenv("PATH", str(tmp_path))
        for name in names:
            (tmp_path / name).touch(0o755)

    installs()
    return installs


@pytest.mark.usefixtures("only")
def test_a_robot_without_camera_and_microphone_needs_nothing(tmp_path: Path) -> None:
    config = config_of({"enabled": False})
    assert [*cameras(config, tmp_path), *microphone(config)] == []


def test_everything_there(tmp_path: Path, only: Programs) -> None:
    only("arecord")
    (tmp_path / "video0").touch()
    config = config_of({"enabled": True, "video": {"device": "0"}})
    results = [*cameras(config, tmp_path), *microphone(config)]
    assert [result.state for result in results] == [State.OK] * 2


@pytest.mark.usefixtures("only")
def test_nothing_there(tmp_path: Path) -> None:
    config = config_of({"enabled": True, "video": {"device": str(tmp_path / "video0")}})
    (no_camera,), (no_microphone,) = cameras(config, tmp_path), microphone(config)
    assert (no_camera.state, no_microphone.state) == (State.FAILED, State.FAILED)
    assert "alsa-utils" in no_microphone.fix
    assert "video0 does not exist" in no_camera.text


@pytest.mark.parametrize(
    ("player", "state", "fix"),
    [
        ("aplay", State.WARN, "sudo apt install alsa-utils"),
        ("/no/such/player", State.WARN, "install /no/such/player, or name another"),
        ("sh", State.OK, ""),
    ],
)
def test_the_player_of_sounds(player: str, state: State, fix: str, only: Programs) -> None:
    only("sh")
    services = {"soundboard_handler": {"enabled": True, "playback": {"player_command": [player]}}}
    config = parse({"robot": {"id": "rover"}, "services": services}, folder=Path.cwd(), env={})
    (result,) = loudspeaker(config)
    assert (result.state, result.fix.startswith(fix)) == (state, True)


@pytest.mark.parametrize(
    ("backend", "level"), [("synthetic", State.OK), ("libcamera", State.FAILED), ("picamera2", State.FAILED)]
)
def test_other_cameras(backend: str, level: State, tmp_path: Path, only: Programs) -> None:
    assert camera(backend, "", tmp_path).state is level
    only("rpicam-vid")
    assert camera(backend, "", tmp_path).state is State.OK
