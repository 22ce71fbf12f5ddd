"""What ``pebble check`` prints and refuses."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from tests.commands.command_line import Run, config_file
from tests.support import ROOT


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("[!s]*.json")), ids=lambda path: path.stem)
def test_every_config_we_ship_is_right(run: Run, path: Path) -> None:
    assert run("check", path) == 0
    assert run.err == ""
    assert run.out.startswith("pebble/")
    assert max(map(len, run.out.splitlines())) <= 80


def test_check_reads_the_certificates(run: Run, tmp_path: Path) -> None:
    for name in ("ca.pem", "me.pem", "me.key"):
        (tmp_path / name).write_text("junk")
    tls = {"enabled": True, "ca_cert": "ca.pem"}
    bridge = {"enabled": True, "remote_mqtt": {"host": "broker.example", "tls": tls}}
    transport = {"kind": "zenoh", "tls": {"enabled": True, "client_cert": "me.pem", "client_key": "me.key"}}
    path = config_file(tmp_path, local_mqtt={"tls": tls}, transport=transport, services={"mqtt_bridge": bridge})
    assert run("check", path) == 1
    assert [line.split(": ")[2] for line in run.err.splitlines()] == [
        "transport.tls.client_cert",
        "services.mqtt_bridge.remote_mqtt.tls.ca_cert",
    ], "local_mqtt is not in use"
    assert f"remote_mqtt.tls.ca_cert: {tmp_path / 'ca.pem'} cannot be used: " in run.err


def test_it_needs_a_config(run: Run) -> None:
    assert run("check") == 2
    assert "name a config" in run.err


LONG = "u" * 100
RUN_DIR = f"transport.run_dir: {{}}/{LONG} is too long for the sockets in it, set it to a shorter path"
SOCKET = f"services.av_daemon.video.socket_path: {{}}/{LONG} is too long for a socket"


@pytest.mark.parametrize(
    ("kind", "run_dir", "devices", "problem"),
    [
        ("zenoh", LONG, {}, RUN_DIR),
        ("mqtt", "run", {"av_daemon": {"enabled": True, "video": {"socket_path": LONG}}}, SOCKET),
    ],
)
def test_check_and_up_refuse_paths_that_are_too_long(
    run: Run, tmp_path: Path, kind: str, run_dir: str, devices: dict[str, object], problem: str
) -> None:
    path = config_file(tmp_path, transport={"kind": kind, "run_dir": str(tmp_path / run_dir)}, services=devices)
    for command in ("check", "up"):
        assert run(command, path) == 1
        assert problem.format(tmp_path) in run.err
    assert not (tmp_path / LONG).exists()


def test_check_shows_links_processes_and_effective_topics_but_no_secret(run: Run, tmp_path: Path) -> None:
    remote = {"host": "broker.example", "username": "goob", "password": "hush-hush"}
    bridge = {"enabled": True, "remote_mqtt": remote, "heartbeat": {"topic": "else/where"}}
    serial = {"enabled": True, "serial": {"port": "/dev/ttyACM7"}}
    path = config_file(
        tmp_path, transport={"kind": "zenoh"}, services={"mqtt_bridge": bridge, "serial_mcu_bridge": serial}
    )
    assert run("check", path, columns=120) == 0
    for expected in ("broker.example:1883", "user goob, password ***", "/dev/ttyACM7", "else/where",
                     "zenoh_hub, serial_mcu_bridge, mqtt_bridge",
                     "incoming/drive-values", "incoming/flags/reboot"):  # fmt: skip
        assert expected in run.out
    assert "outgoing/online" not in run.out
    assert run("check", path, "--json") == 0
    assert json.loads(run.out)["services"]["mqtt_bridge"]["heartbeat"]["topic"] == "else/where"
    assert "hush-hush" not in run.out


def bridge(**settings: object) -> dict[str, object]:
    return {"services": {"mqtt_bridge": {"enabled": True, **settings}}}


@pytest.mark.parametrize(
    ("keys", "shared"),
    [
        ({}, True),
        ({"robot": {"id": "goob", "platform": "esp8266"}}, True),
        (bridge(remote_mqtt={"host": "broker.example"}), False),
        (bridge(remote_mqtt={"host": "127.0.0.1", "port": 1884}), False),
        (bridge(remote={"kind": "mqtt"}, remote_mqtt={"host": "::1"}), True),
        (bridge(remote={"kind": "zenoh", "connect": ["tcp/10.0.0.2:7447"]}), False),
        ({"transport": {"kind": "zenoh"}}, False),
        ({"transport": {"kind": "zenoh", "mqtt_mirror": {"host": "127.0.0.1"}}}, True),
    ],
)
def test_check_names_the_broker_where_others_may_pose_as_a_script(
    run: Run, tmp_path: Path, keys: dict[str, object], shared: bool
) -> None:
    assert run("check", config_file(tmp_path, **{"local_mqtt": {"host": "127.0.0.1"}, **keys}), columns=160) == 0
    assert ("anybody at broker 127.0.0.1:1883 may pose as one, or end one" in run.out) == shared


def test_check_reports_every_problem_of_every_file(run: Run, tmp_path: Path) -> None:
    wrong = {"robot": {"id": "goob", "sistem": "x"}, "local_mqtt": {"port": "x"}, "services": {"mqtt_brigde": {}}}
    path = config_file(tmp_path, **wrong)
    assert run("check", path, ROOT / "configs" / "fred.json") == 1
    assert len(run.err.splitlines()) == 3
    for named in ("robot.sistem", "local_mqtt.port", "services.mqtt_brigde"):
        assert f"pebble: robot.json: {named}" in run.err
    assert "pebble/robots/fred" in run.out


def test_check_lists_every_script_and_whether_it_runs(run: Run, tmp_path: Path) -> None:
    texts = {"apriltag-locations": "import cv3", "patrol": "", "torn": "def main(:"}
    for name, text in (texts | dict.fromkeys(("other", "own-python", "own-path"), "import cv3")).items():
        (tmp_path / "autonomy" / name).mkdir(parents=True)
        (tmp_path / "autonomy" / name / "run.py").write_text(text)
    ran, other = tmp_path / "ran", tmp_path / "autonomy" / "other"
    for file in (tmp_path / "autonomy/apriltag-locations/importlib.py", other / "sitecustomize.py"):
        file.write_text(f"open({str(ran)!r}, 'w')")
    (other / "program").write_text(f"#!/bin/sh\ntouch {ran}\n")
    (other / "program").chmod(0o755)
    (other / "script.json").write_text(json.dumps({"command": ["./program", str(other / "run.py")]}))
    scripts = {"patrol": {"python": sys.executable}, "own-python": {"python": "./autonomy/other/program"}}
    manager = {"enabled": True, "scripts": scripts | {"own-path": {"env": {"PYTHONPATH": str(other)}}}}
    assert run("check", config_file(tmp_path, services={"autonomy_manager": manager}), columns=300) == 0
    lines = [" ".join(line.split()) for line in run.out.splitlines()]
    for expected in (
        "apriltag-locations runs with /usr/bin/python3, which lacks cv3",
        f"patrol runs with {sys.executable}",
        "wheel-odometry runs, Pebble's own",
    ):
        assert f"script {expected}" in lines
    assert not ran.exists(), "a check runs nothing of a script"
    assert any(line.startswith("script torn does not run: run.py, line 1: ") for line in lines)
