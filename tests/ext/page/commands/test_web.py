"""``pebble web`` starts only where it is safe, and administers its users."""

from __future__ import annotations

import io
import json
import os
import signal
import ssl
import stat
import subprocess
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.extensions.fleet.audit import Audit
from pebble.extensions.fleet.people import People
from pebble.extensions.fleet.roles import Role
from pebble.extensions.page.setting import WebSettings
from tests.commands.command_line import Run, config_file, program
from tests.support import Broker, free_port

SECRET = "sentinel-8472"
BROKER = {"services": {"mqtt_bridge": {"remote_mqtt": {"host": "broker.example"}}}}


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


# -- where it may be served


def test_for_this_machine_it_needs_nothing(run: Run, served: list[WebSettings], state: Path) -> None:
    assert run("web", "--url", "mqtt://me@broker.example:1884") == 0, run.err
    (settings,) = served
    assert (settings.host, settings.port, settings.login, settings.certificate) == ("127.0.0.1", 8080, False, None)
    assert (settings.broker.host, settings.broker.port, settings.broker.username) == ("broker.example", 1884, "me")
    assert settings.people == state / "people.sqlite"


def test_from_a_config(run: Run, served: list[WebSettings], tmp_path: Path) -> None:
    web = {"port": 8888, "names": ["a.local"], "server": "fair-1"}
    config = config_file(
        tmp_path, web_interface=web, transport={"kind": "mqtt", "state_dir": str(tmp_path / "robot")}, **BROKER
    )
    assert run("web", config, "--name", "b.local") == 0, run.err
    assert run("web", "serve", config, "--port", "0", "--people", tmp_path / "p.sqlite") == 0, run.err
    first, second = served
    assert (first.broker.host, first.port, first.names) == ("broker.example", 8888, ("a.local", "b.local"))
    assert (first.server, first.people) == ("fair-1", tmp_path / "robot/people.sqlite")
    assert (second.port, second.people) == (0, tmp_path / "p.sqlite")


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
    for settings in served:
        assert settings.login
        assert settings.certificate == state / "tls/server.pem"
        assert settings.key == state / "tls/server.key"
        assert settings.authority == state / "tls/ca.pem"


@pytest.mark.parametrize(
    ("added", "counts"),
    [
        ([()], "state/pebble/web"),  # as docs/ext/page.md has it
        ([("--config", "r.json")], "robot"),
        ([(), ("--config", "r.json")], "robot"),
        ([("--people", "other.sqlite")], ""),
    ],
    ids=["of this user", "of the robot", "of both", "of neither"],
)
def test_whose_people_may_use_the_page_of_a_config(
    run: Run,
    served: list[WebSettings],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    added: list[tuple[str, ...]],
    counts: str,
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
        (["x.json", "--url", "mqtt://a"], "which robots is missing"),
        (["--url", "http://a"], "--url must be mqtt://"),
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
    user = people.check("alice", SECRET, "")
    assert user is not None
    token = people.start_session(user)
    assert run("web", "user", "role", "alice", "admin") == 0
    assert run("web", "user", "list") == 0
    assert run.out.split() == ["alice", "admin"]
    session = people.session(token)
    assert session is not None
    assert session.role is Role.ADMIN
    give(monkeypatch, "another password")
    assert run("web", "user", "password", "alice") == 0
    assert people.session(token) is None
    assert people.check("alice", "another password", "") is not None
    assert run("web", "user", "remove", "alice") == 0
    assert people.list() == []
    people.close()


def test_mistakes_with_users(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse at the prompt; the rules for names and passwords are tested where people are kept."""
    for given, why in (("short\n", "a password has 8 to 256 characters"), ("", "no password: enter it at the prompt")):
        give(monkeypatch, given)
        assert run("web", "user", "add", "alice") == 1
        assert run.err.startswith(f"pebble: {why}")
    assert run("web", "user", "add", "alice", SECRET) == 2
    assert run("web", "user", "role", "bob", "admin") == 1
    assert run.err == "pebble: there is no 'bob': `pebble web user list` lists the names\n"
    assert run("web", "user") == 0
    assert "pebble web user add alice --role driver" in run.out


def test_audit(run: Run, state: Path) -> None:
    assert run("web", "audit") == 0
    assert run.out == f"{state / 'people.sqlite'} has no entries yet\n"
    log = Audit(state / "people.sqlite")
    for number in range(60):
        log.write(f"drive-{number}", ref="pebble/robots/goob", user="alice", device="phone", address="10.0.0.2")
    for _ in range(2000):
        log.write("login-refused", user="[red]dog[/red] \x1b[2J\x07\n\u202e\u200f\x9b", address="::1")
    log.close()
    assert run("web", "audit", "--limit", "3", columns=200) == 0
    lines = run.out.splitlines()
    assert lines[0].split() == ["time", "what", "robot", "user", "device", "address", "detail"]
    assert lines[1].split()[2:] == ["drive-59", "pebble/robots/goob", "alice", "phone", "10.0.0.2"]
    assert lines[2].split()[2] == "login-refused"
    assert "login-refused × 1,999 " in lines[3]
    assert all(r"[red]dog[/red] \u001b[2J\u0007\u000a\u202e\u200f\u009b" in line for line in lines[2:])


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
    assert (process.communicate(timeout=10)[1], process.returncode) == ("", 130)
