"""Pebble in a container: its files, and a faked container with and without a volume. No daemon is needed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from pebble.config import parse
from pebble.extensions.install.container import facts
from pebble.motors import state_file
from pebble.motors.state_file import StateFile
from tests.support import ROOT, until

FOLDER = ROOT / "packaging" / "container"


def services() -> dict[str, dict[str, Any]]:
    files = (yaml.safe_load((FOLDER / name).read_text()) for name in ("compose.yaml", "compose.robot.yaml"))
    return {name: service for file in files for name, service in file["services"].items()}


@pytest.mark.parametrize("name", ["broker", "page", "robot"])
def test_each_container_is_confined_and_has_time_to_stop(name: str) -> None:
    service = services()[name]
    assert (service["restart"], service["stop_grace_period"]) == ("unless-stopped", "15s")
    assert (service["read_only"], service["cap_drop"], service["tmpfs"]) == (True, ["ALL"], ["/tmp", "/run"])
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service.get("build", {"dockerfile": "packaging/container/Containerfile"})["dockerfile"].startswith(
        "packaging"
    )


def test_what_must_outlive_a_container_is_on_a_volume() -> None:
    assert "PEBBLE_CONTAINER=1 XDG_STATE_HOME=/state" in (FOLDER / "Containerfile").read_text()
    page, robot = services()["page"], services()["robot"]
    assert {"people:/people", "state:/state"} <= {*page["volumes"]}
    assert "state:/state" in robot["volumes"]
    assert (robot["network_mode"], robot["shm_size"]) == ("host", "256m")
    assert robot["group_add"] == ["dialout", "video", "audio"]


@pytest.mark.parametrize("volume", [True, False])
def test_a_stop_in_a_container_is_saved_on_a_volume_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, volume: bool
) -> None:
    """A faked container: the parent of its state directory is a mount."""
    monkeypatch.setenv("PEBBLE_CONTAINER", "1")
    monkeypatch.setattr(Path, "is_mount", lambda path: path in (tmp_path, Path("/")))
    monkeypatch.setattr(state_file, "LOST", ("/", *([] if volume else [str(tmp_path)])))
    results: list[bool] = []
    file = StateFile(tmp_path / "state/estop.json", lambda _, succeeded: results.append(succeeded))
    assert file.can_save()
    file.save({"latched": True})
    assert until(lambda: results == [volume])
    file.close()
    assert ("NOT SAVED: no volume holds" in caplog.text) is not volume
    transport = {"kind": "zenoh", "state_dir": str(tmp_path / "state")}
    serial = {"serial_mcu_bridge": {"enabled": True, "serial": {"port": "/dev/ttyACM0"}}}
    config = parse({"robot": {"id": "goob"}, "transport": transport, "services": serial}, folder=tmp_path, env={})
    lines = [line for _, line in facts(config).table]
    assert ("NOT SAVED" in lines[0]) is not volume
    assert any("/dev/serial/by-id" in line for line in lines)
