"""Checks of camera, microphone and codecs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pebble.check_result import State
from pebble.config import Config, parse
from pebble.doctor.media import camera, codecs, media, shm_socket


def config_of(devices: dict[str, Any], **sent: Any) -> Config:
    services = {"av_daemon": devices, "mqtt_bridge": {"media": sent}}
    return parse({"robot": {"id": "rover"}, "services": services}, folder=Path.cwd(), env={})


def nothing(_name: str) -> None:
    return None


def everything(name: str) -> str:
    return f"/usr/bin/{name}"


def test_a_robot_without_camera_and_microphone_needs_nothing(tmp_path: Path) -> None:
    assert list(media(config_of({"enabled": False}), tmp_path, nothing)) == []


def test_everything_there(tmp_path: Path) -> None:
    (tmp_path / "video0").touch()
    config = config_of({"enabled": True, "video": {"device": "0"}})
    found = list(media(config, tmp_path, everything))
    assert {finding.state for finding in found} == {State.OK}
    assert [finding.what for finding in found] == ["camera", "microphone", "codecs"]


def test_nothing_there(tmp_path: Path) -> None:
    config = config_of({"enabled": True, "video": {"device": str(tmp_path / "video0")}})
    found = {finding.what: finding for finding in media(config, tmp_path, nothing)}
    assert [found[what].state for what in ("camera", "microphone")] == [State.FAILED, State.FAILED]
    assert "alsa-utils" in found["microphone"].fix
    assert "video0 does not exist" in found["camera"].text


def test_sockets_for_scripts_of_the_original(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    devices = {
        "enabled": True,
        "video": {"backend": "synthetic", "socket_path": str(tmp_path / "v.sock")},
        "audio": {"source": "synthetic", "socket_path": str(tmp_path / "none" / "a.sock")},
    }
    found = {finding.what: finding for finding in media(config_of(devices), tmp_path, nothing)}
    assert found["video for the original's scripts"].state is State.OK
    assert "there is no folder" in found["audio for the original's scripts"].text
    assert shm_socket("x", tmp_path / "file").text.endswith("is a file and no socket")


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
    assert codecs(config, installed=False).state is level
    assert codecs(config, installed=True).state is State.OK
