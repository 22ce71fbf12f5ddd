"""``pebble web`` and the page as a process of a robot: where they may serve, their settings, users and certificates."""

from __future__ import annotations

import io
import json
import os
import signal
import socket
import ssl
import stat
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from pebble.config import load, parse
from pebble.errors import ConfigError
from pebble.extensions.fleet.audit import Audit
from pebble.extensions.fleet.people import People
from pebble.extensions.fleet.roles import Role
from pebble.extensions.page.setting import WebSettings, settings_of
from tests.commands.command_line import Run, config_file, program
from tests.kit.terminal import Terminal
from tests.support import ROOT, SOON_S, WAIT_S, Broker, Child, free_port

SECRET = "sentinel-8472"
BROKER = {"services": {"mqtt_bridge": {"remote_mqtt": {"host": "broker.example"}}}}


@pytest.fixture(autouse=True)
def state(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Return the folder in which commands keep what they store."""
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state/pebble/web"


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[WebSettings]]:
    """The settings with which the server would run."""
    settings: list[WebSettings] = []
    monkeypatch.setattr("pebble.extensions.page.serve.run", lambda given, **_: settings.append(given) or 0)
    before = signal.getsignal(signal.SIGHUP)
    yield settings
    signal.signal(signal.SIGHUP, before)


def give(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(text))


def test_a_terminal_that_stands_still_delays_no_answer_to_a_page(broker: Broker) -> None:
    port = free_port()
    console = Terminal(sys.executable, "-m", "pebble", "web", f"--url=mqtt://127.0.0.1:{broker.port}", f"--port={port}")
    with closing(console):
        assert console.sees("(Ctrl-C ends it)"), console.shown
        with console.standing_still():
            for _ in range(2):  # of each a line is printed
                with socket.create_connection(("127.0.0.1", port), SOON_S) as stranger:
                    stranger.sendall(b"no request\r\n\r\n")
                    assert stranger.recv(100).startswith(b"HTTP/1.1 400")
            assert urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=SOON_S).status == 200
        assert console.sees("Invalid HTTP request received.")


# -- where it may be served


def test_for_this_machine_it_needs_nothing(run: Run, served: list[WebSettings], state: Path) -> None:
    assert run("web", "--url", "mqtt://me@broker.example:1884") == 0, run.err
    (settings,) = served
    assert (settings.host, settings.port, settings.login, settings.certificate) == ("127.0.0.1", 8080, False, None)
    assert (settings.broker.host, settings.broker.port, settings.broker.username) == ("broker.example", 1884, "me")
    assert settings.people == state / "people.sqlite"


def test_from_a_config_and_options(run: Run, served: list[WebSettings], tmp_path: Path) -> None:
    web = {"port": 8888, "names": ["a.local"], "server": "fair-1"}
    config = config_file(tmp_path, web_interface=web, **BROKER)
    assert run("web", config, "--name", "b.local", "--port", "0", "--people", tmp_path / "p.sqlite") == 0, run.err
    (settings,) = served
    assert (settings.broker.host, settings.port, settings.names) == ("broker.example", 0, ("a.local", "b.local"))
    assert (settings.server, settings.people) == ("fair-1", tmp_path / "p.sqlite")


def test_the_printed_commands_make_it_start(
    run: Run, served: list[WebSettings], state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = ("web", "--url", "mqtt://broker.example", "--host", "0.0.0.0")
    assert run(*line) == 2
    assert run.err.startswith("pebble: other machines reach 0.0.0.0, so the page needs a certificate and a user:\n")
    commands = [text.split()[1:] for text in run.err.splitlines()[1:]]
    assert len(commands) == 3
    assert served == []
    assert run(*commands[0]) == 0, run.err
    assert run(*line) == 2
    assert run.err.splitlines()[0].endswith("so the page needs a user:")
    assert len(run.err.splitlines()) == 3
    give(monkeypatch, f"{SECRET}\n")
    assert run(*commands[1]) == 0, run.err
    assert run(*commands[2]) == 0, run.err
    assert run(*line) == 0, run.err
    tls = [(one.login, one.certificate, one.key, one.authority) for one in served]
    assert set(tls) == {(True, *(state / "tls" / name for name in ("server.pem", "server.key", "ca.pem")))}


@pytest.mark.parametrize(
    ("added", "counts"),
    [
        ([()], "state/pebble/web"),  # as docs/ext/page.md has it
        ([(), ("--config", "r.json")], "robot"),
        ([("--people", "other.sqlite")], ""),
    ],
    ids=["of this user", "of both", "of neither"],
)
def test_whose_people_may_use_the_page_of_a_config(
    run: Run, served: list[WebSettings], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, added: list[Any], counts: str
) -> None:
    monkeypatch.chdir(tmp_path)
    made = config_file(tmp_path, transport={"kind": "mqtt", "state_dir": str(tmp_path / "robot")}, **BROKER)
    Path(made).rename("r.json")
    for number, options in enumerate(added):
        give(monkeypatch, f"{SECRET}\n")
        assert run("web", "user", "add", f"ann{number}", *options) == 0, run.err
    assert run("cert", "init", "lab.local") == 0
    assert run("web", "r.json", "--host", "0.0.0.0") == (0 if counts else 2), run.err
    assert [settings.people for settings in served] == ([tmp_path / counts / "people.sqlite"] if counts else [])


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ([], "which robots is missing: name either a robot's config file or --url mqtt://BROKER"),
        (["--url", "zenoh:/tmp"], "--url must be mqtt://"),
        (["--url", f"mqtt://me:{SECRET}@a"], "--url holds a password"),
    ],
)
def test_mistakes_are_one_line(run: Run, served: list[WebSettings], arguments: list[str], why: str) -> None:
    assert run("web", *arguments) == 1
    assert run.err.startswith(f"pebble: {why}")
    assert run.err.count("\n") == 1
    assert SECRET not in run.err
    assert served == []


# -- users


def test_users(run: Run, monkeypatch: pytest.MonkeyPatch, state: Path) -> None:
    assert run("web", "user", "list") == 0
    assert run.out == f"{state}/people.sqlite has no user yet: pebble web user add NAME\n"
    give(monkeypatch, f"{SECRET}\nnot read\n")
    assert run("web", "user", "add", "alice") == 0, run.err
    assert run.out == f"alice may log in as driver ({state}/people.sqlite)\n"
    assert stat.S_IMODE((state / "people.sqlite").stat().st_mode) == 0o600
    people = People(state / "people.sqlite")
    assert people.check("alice", SECRET, "")
    assert run("web", "user", "role", "alice", "admin") == 0
    assert run("web", "user", "list") == 0
    assert run.out.split() == ["alice", "admin"]
    give(monkeypatch, "another password")
    assert run("web", "user", "password", "alice") == 0
    assert people.check("alice", "another password", "") is not None
    assert run("web", "user", "remove", "alice") == 0
    assert people.list() == []
    people.close()


def test_audit(run: Run, state: Path) -> None:
    log = Audit(state / "people.sqlite")
    log.write("drive", ref="pebble/robots/goob", user="alice", device="phone", address="10.0.0.2")
    for _ in range(2000):
        log.write("login-refused", user="[red]dog[/red] \x1b[2J\x07\n\u202e\u200f\x9b", address="::1")
    log.close()
    assert run("web", "audit", "--limit", "3", columns=200) == 0
    _, first, *others = run.out.splitlines()
    assert first.split()[2:] == ["drive", "pebble/robots/goob", "alice", "phone", "10.0.0.2"]
    assert "login-refused × 1,999 " in others[1]
    assert all(r"[red]dog[/red] \u001b[2J\u0007\u000a\u202e\u200f\u009b" in line for line in others)


# -- certificates, which are tested where they are made


def test_a_certificate_is_made_with_what_to_type_next_and_how_phones_trust_it(run: Run, state: Path) -> None:
    state /= "tls"
    assert run("cert", "init", "lab-pc.local", "192.168.1.20") == 0, run.err
    lines = run.out.splitlines()
    assert lines[0] == f"{state} has a certificate for lab-pc.local, 192.168.1.20."
    assert lines[2] == f"    pebble web CONFIG --host 0.0.0.0 --tls {state}"
    assert "https://lab-pc.local:PORT/ca.pem" in run.out
    assert sorted(path.name for path in state.iterdir()) == ["ca.key", "ca.pem", "server.key", "server.pem"]
    assert stat.S_IMODE((state / "ca.key").stat().st_mode) == 0o600


# -- the real server


def started(*arguments: str) -> tuple[subprocess.Popen[str], str]:
    process = program("web", *arguments)
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line.startswith("The operator page is at "), (line, process.stderr.read() if process.stderr else "")
    return process, line.split()[5]


def test_a_port_in_use_is_named(run: Run, broker: Broker) -> None:
    assert run("web", "--url", f"mqtt://127.0.0.1:{broker.port}", "--port", broker.port) == 1
    fact = f"Address already in use (by process {broker.pid} of user {os.getuid()}: '"
    assert run.err.startswith(f"pebble: cannot listen on 127.0.0.1 port {broker.port}: {fact}")


def test_it_says_when_the_broker_cannot_be_reached_and_when_it_can_again(tmp_path: Path) -> None:
    broker = Broker(tmp_path)
    broker.kill()
    process, _ = started("--url", f"mqtt://127.0.0.1:{broker.port}", "--port", "0")
    assert process.stderr is not None
    lines = [process.stderr.readline()]
    for change in (broker.start, broker.kill):
        change()
        lines.append(process.stderr.readline())
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=WAIT_S)[1] == ""
    at = f"broker 127.0.0.1:{broker.port}"
    assert lines == [
        f"pebble: {at} cannot be reached: nothing listens there, is it up? (trying again)\n",
        "pebble: connected to the broker\n",
        f"pebble: {at} closed the connection (trying again)\n",
    ]


def test_it_serves_https_with_a_certificate_of_ones_own_until_ctrl_c(run: Run, broker: Broker, tmp_path: Path) -> None:
    people = People(tmp_path / "people.sqlite")
    people.add("alice", SECRET, Role.DRIVER)
    people.close()
    assert run("cert", "init", "--folder", tmp_path / "tls", "localhost", "127.0.0.1") == 0
    options = ["--tls", str(tmp_path / "tls"), "--people", str(tmp_path / "people.sqlite"), "--name", "localhost"]
    process, url = started("--url", f"mqtt://127.0.0.1:{broker.port}", "--port", str(free_port()), *options)
    assert url.startswith("https://localhost:")
    trusting = ssl.create_default_context(cafile=tmp_path / "tls/ca.pem")
    body = json.dumps({"user": "alice", "password": SECRET}).encode()
    headers = {"content-type": "application/json", "origin": url.rstrip("/")}
    request = urllib.request.Request(f"{url}api/login", body, headers)
    with urllib.request.urlopen(request, context=trusting) as response:
        cookie = response.headers["set-cookie"]
    assert cookie.startswith("__Host-pebble=")
    authority = (tmp_path / "tls/ca.pem").read_bytes()
    (tmp_path / "tls/ca.pem").write_bytes((tmp_path / "tls/ca.key").read_bytes() + authority)
    with urllib.request.urlopen(f"{url}ca.pem", context=trusting) as response:
        assert response.read() == authority, "what else is in the file is not shown"
    process.send_signal(signal.SIGINT)
    assert (process.communicate(timeout=WAIT_S)[1], process.returncode) == ("", 130)


# -- a process of a robot


REMOTE: dict[str, Any] = {
    "services": {"mqtt_bridge": {"remote_mqtt": {"host": "broker.example", "port": 8883, "username": "goob"}}}
}


def settings(web: dict[str, Any], folder: Path = Path("/nowhere"), **more: Any) -> WebSettings:
    raw = {"robot": {"id": "goob"}, "web_interface": web, "transport": {"kind": "mqtt", "state_dir": "/state"}, **more}
    return settings_of(parse(raw, folder=folder, env={}))


def problem(web: dict[str, Any], folder: Path = Path("/nowhere"), **more: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        settings(web, folder, **more)
    (found,) = caught.value.problems
    return found


ZENOH: dict[str, Any] = {"services": {"mqtt_bridge": {"remote": {"kind": "zenoh", "connect": ["tcp/10.0.0.1:7447"]}}}}
OPEN = {"host": "0.0.0.0", "plain_http": True}
#: Of the config its section for the page and what else there is, and fields of the settings.
SETTINGS: list[tuple[dict[str, Any], dict[str, Any], dict[str, Any]]] = [
    ({}, REMOTE, {"host": "127.0.0.1", "port": 8080, "login": False, "certificate": None}),
    ({}, REMOTE, {"people": Path("/state/people.sqlite"), "broker": ("broker.example", 8883, "goob")}),
    ({"mqtt": {"host": "10.0.0.1", "username": "page"}}, REMOTE, {"broker": ("10.0.0.1", 1883, "page")}),
    ({"mqtt": {"host": "10.0.0.1"}}, ZENOH, {"broker": ("10.0.0.1", 1883, None)}),
    (OPEN, REMOTE, {"login": True, "certificate": None, "plain_http_drive": False}),
    (OPEN | {"plain_http_drive": True}, REMOTE, {"plain_http_drive": True}),
]


@pytest.mark.parametrize(("web", "more", "expected"), SETTINGS)
def test_settings(web: dict[str, Any], more: dict[str, Any], expected: dict[str, Any]) -> None:
    made = settings(web, **more)
    broker = made.broker.host, made.broker.port, made.broker.username
    assert {key: broker if key == "broker" else getattr(made, key) for key in expected} == expected


def test_a_missing_broker_is_named() -> None:
    assert problem({}).startswith("web_interface.mqtt.host: is missing, and so is services.mqtt_bridge.remote_mqtt")
    assert 'the robot\'s own connection is "zenoh"' in problem({}, **ZENOH)


def test_a_certificate_needs_its_files(tmp_path: Path) -> None:
    tls = {"certificate": "server.pem", "key": "server.key", "ca": "ca.pem"}
    web = {"host": "0.0.0.0", "tls": tls, "names": ["fair.local"], "server": "fair"}
    assert problem(web, tmp_path, **REMOTE).startswith(
        f"web_interface.tls.certificate: {tmp_path}/server.pem cannot be"
    )
    for name in tls.values():
        (tmp_path / name).write_text("x")
    made = settings(web, tmp_path, **REMOTE)
    assert (made.login, made.names, made.server) == (True, ("fair.local",), "fair")
    assert (made.certificate, made.key, made.authority) == tuple(tmp_path / name for name in tls.values())


def test_a_config_of_the_original_is_refused_with_what_to_do() -> None:
    with pytest.raises(ConfigError, match=r"web_interface\.host: other machines reach 0\.0\.0\.0"):
        settings_of(load(ROOT / "tests" / "data" / "original-shaped-config.json", env={}))


def written(folder: Path, web: dict[str, Any]) -> Path:
    path = folder / "goob.json"
    raw = {
        "robot": {"id": "goob"},
        "transport": {"kind": "mqtt", "run_dir": str(folder / "run"), "state_dir": str(folder / "state")},
        "services": {"web_handler": {"enabled": True}},
        "web_interface": web,
    }
    path.write_text(json.dumps(raw))
    return path


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
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=WAIT_S) as answer:
            assert answer.status == 200
        page.terminate()
        assert page.wait(WAIT_S) == 0
