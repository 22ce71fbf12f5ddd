"""The operator page as a process of the robot: what it refuses, and how the launcher shows it."""

from __future__ import annotations

import json
import os
import sys
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.operator.client import page_packages
from pebble.extensions.page import run
from tests.support import ROOT, Broker, Child, free_port


def written(folder: Path, web: dict[str, Any], **services: Any) -> Path:
    path = folder / "goob.json"
    raw = {
        "robot": {"id": "goob"},
        "transport": {"kind": "mqtt", "run_dir": str(folder / "run"), "state_dir": str(folder / "state")},
        "services": {"web_handler": {"enabled": True}, **services},
        "web_interface": web,
    }
    path.write_text(json.dumps(raw))
    return path


def test_a_page_that_cannot_start_ends_with_one_line(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert run.main([str(written(tmp_path, {}))]) == 1
    assert [record.message.partition(":")[0] for record in caplog.records] == ["web_interface.mqtt.host"]


def test_missing_packages_are_named_with_the_command_that_installs_them(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_packages, "find_spec", lambda name: None if name == "uvicorn" else object())
    assert run.main([str(written(tmp_path, {"mqtt": {"host": "127.0.0.1"}}))]) == 1
    assert "(uvicorn): pip install 'pebble-robot[web]'" in caplog.text


def test_the_command_line_is_one_config(capsys: pytest.CaptureFixture[str]) -> None:
    assert run.main([]) == 2
    assert "usage" in capsys.readouterr().err


def test_it_reports_that_it_is_ready_and_alive_and_ends_by_a_signal(tmp_path: Path, broker: Broker) -> None:
    port = free_port()
    config = written(tmp_path, {"port": port, "mqtt": {"host": "127.0.0.1", "port": broker.port}})
    reader, writer = os.pipe()
    page = Child(
        [sys.executable, "-m", "pebble.extensions.page.run", str(config)],
        cwd=ROOT,
        env=os.environ | {"PEBBLE_NOTIFY_FD": str(writer)},
        pass_fds=[writer],
    )
    os.close(writer)
    with os.fdopen(reader) as notes:
        assert [json.loads(notes.readline())["note"] for _ in range(3)] == ["ready", "alive", "alive"]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=5) as answer:
            assert answer.status == 200
        page.terminate()
        assert page.wait(5) == 0
