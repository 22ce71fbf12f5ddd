"""Checks of camera, microphone, codecs and loudspeaker."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest

from pebble.checks.check import State
from pebble.checks.media import camera, cameras, codecs, loudspeaker, microphone, sockets_of_the_original
from pebble.config import Config, parse


def config_of(devices: dict[str, Any], **sent: Any) -> Config:
    services = {"av_daemon": devices, "mqtt_bridge": {"media": sent}}
    return parse({"robot": {"id": "rover"}, "services": services}, folder=Path.cwd(), env={})


def nothing(_name: str) -> None:
    return None


def everything(name: str) -> str:
    return f"/usr/bin/{name}"


def test_a_robot_without_camera_and_microphone_needs_nothing(tmp_path: Path) -> None:
    config = config_of({"enabled": False})
    assert [*cameras(config, tmp_path, nothing), *microphone(config, nothing), *codecs(config)] == []


def test_everything_there(tmp_path: Path) -> None:
    (tmp_path / "video0").touch()
    config = config_of({"enabled": True, "video": {"device": "0"}})
    results = [*cameras(config, tmp_path, everything), *microphone(config, everything), *codecs(config)]
    assert [result.state for result in results] == [State.OK] * 3


def test_nothing_there(tmp_path: Path) -> None:
    config = config_of({"enabled": True, "video": {"device": str(tmp_path / "video0")}})
    (no_camera,), (no_microphone,) = cameras(config, tmp_path, nothing), microphone(config, nothing)
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
def test_the_player_of_sounds(player: str, state: State, fix: str) -> None:
    services = {"soundboard_handler": {"enabled": True, "playback": {"player_command": [player]}}}
    config = parse({"robot": {"id": "rover"}, "services": services}, folder=Path.cwd(), env={})
    (result,) = loudspeaker(config, lambda name: "/bin/sh" if name == "sh" else None)
    assert (result.state, result.fix.startswith(fix)) == (state, True)


def test_sockets_for_scripts_of_the_original(tmp_path: Path) -> None:
    path = tmp_path / "v.sock"
    config = config_of({"enabled": True, "video": {"backend": "synthetic", "socket_path": str(path)}})
    (missing,), (unserved,) = (sockets_of_the_original(config, which) for which in (nothing, everything))
    socket.socket(socket.AF_UNIX).bind(str(path))
    (served,) = sockets_of_the_original(config, everything)
    assert [result.state for result in (missing, unserved, served)] == [State.WARN, State.WARN, State.OK]
    assert (missing.text, unserved.text) == (
        f"GStreamer, which serves {path}, is not installed", f"there is no {path} now"
    )  # fmt: skip


@pytest.mark.parametrize(
    ("backend", "level"), [("synthetic", State.OK), ("libcamera", State.FAILED), ("picamera2", State.FAILED)]
)
def test_other_cameras(backend: str, level: State, tmp_path: Path) -> None:
    assert camera(backend, "", tmp_path, nothing).state is level
    assert camera(backend, "", tmp_path, everything).state is State.OK


@pytest.mark.parametrize(
    ("sent", "level"),
    [
        ({}, State.OK),
        ({"video_publisher": {"encoding": "h264"}}, State.FAILED),
        ({"audio_publisher": {"encoding": "opus"}}, State.FAILED),
    ],
)
def test_codecs_are_missed_where_they_are_asked_for(sent: dict[str, Any], level: State) -> None:
    config = config_of({"enabled": True}, **sent)
    assert [result.state for result in codecs(config, installed=False)] == [level]
    assert [result.state for result in codecs(config, installed=True)] == [State.OK]
