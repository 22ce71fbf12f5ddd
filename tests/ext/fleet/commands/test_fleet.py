"""``pebble fleet``: the commands of docs/ext/fleet.md in order, as printed, with a real broker; and what is refused."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from pebble.config import load
from pebble.config.raw import deep_merge
from pebble.extensions.fleet import authority, certificates
from pebble.extensions.fleet.folder import CONF, FLEET, ZENOH
from pebble.extensions.fleet.hub_access import read_access
from pebble.extensions.fleet.hub_file import load_hub
from pebble.extensions.fleet.people import People
from pebble.extensions.fleet.roles import Role
from pebble.extensions.lab.rig.processes import python
from pebble.extensions.operator.places import mosquitto_path
from tests.ext.fleet.broker_client import BrokerClient, Place
from tests.kit.terminal import Terminal
from tests.support import ROOT, Child, free_port, listening, until

PAGE = (ROOT / "docs/ext/fleet.md").read_text()
#: The first block of the page: what a newcomer types, one after the other.
FIRST = re.findall(r"^    (\S.*)$", PAGE.partition("## ")[2].partition("## ")[0], re.MULTILINE)
LAMP = "pebble/robots/minilamp"
MOVES = re.compile(rb'"z": ?0\.[1-9]')
PASSWORD = re.compile(r"password: ((?:[a-z0-9]{4}-){3}[a-z0-9]{4})")


def pebble(line: str, folder: Path, **more: str) -> subprocess.CompletedProcess[str]:
    """Run a line that begins with ``pebble``, in this folder."""
    words = shlex.split(line, comments=True)
    assert words[0] == "pebble"
    command = [sys.executable, "-m", "pebble.cli", *words[1:]]
    env = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_STATE_HOME": str(folder / "state"), **more}
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False, timeout=60)


@contextmanager
def mosquitto(conf: Path, port: int) -> Iterator[None]:
    with (conf.parent / "log").open("ab") as log:
        process = Child([str(mosquitto_path()), "-c", str(conf)], cwd=conf.parent.parent, stdout=log, stderr=log)
    try:
        assert until(lambda: listening(port), 10), (conf.parent / "log").read_text()
        yield
    finally:
        process.kill()
        process.wait(10)


@pytest.mark.parametrize("level", ["login", "named"])
def test_the_first_page_as_a_newcomer_types_it(level: str, tmp_path: Path) -> None:
    """The host is this machine instead of the broker's, and the port a free one: nothing else differs."""
    port, passwords = free_port(), dict[str, str]()
    init, start, *accounts, check = FIRST[:8]
    simulate, drive, stop, *later = (line.replace("broker.lab:8883", f"127.0.0.1:{port}") for line in FIRST[8:])
    assert (
        run(init.replace("broker.lab", f"127.0.0.1 --port {port} --level {level}"), tmp_path).count(
            start.split("  ")[0]
        )
        == 1
    )
    with mosquitto(tmp_path / start.split()[2], port):
        for line in accounts:
            shown = run(line, tmp_path)
            passwords[line.split()[3]] = PASSWORD.findall(shown)[0]
            for piece in re.findall(r"^\{.*^\}", shown, re.DOTALL | re.MULTILINE):
                _robot_accepts(_merged(json.loads(piece), tmp_path), level)
        assert "have its 5 accounts, and their rules" in run(check, tmp_path)
        for name, password in passwords.items():
            (tmp_path / f"{name}-password").write_text(f"{password}\n")
        place = Place("127.0.0.1", port, tmp_path / "hall" / "ca.pem")
        with BrokerClient(place, "minilamp", passwords["minilamp"]) as robot, typed(simulate, tmp_path):
            robot.subscribe([f"{LAMP}/incoming/#", f"{LAMP}/outgoing/estop/#"])
            with closing(Terminal(*python("pebble.cli", *shlex.split(drive)[1:]), cwd=tmp_path)) as console:
                assert console.sees("ready"), console.shown
                console.hold(b"w")
                assert until(lambda: robot.listen(0.05) or any(MOVES.search(one) for _, one in robot.received), 20)
            assert "stopped and confirmed" in run(stop, tmp_path)
            assert until(lambda: robot.listen(0.05) or any(b'"latched":true' in one for _, one in robot.received), 5)
        for line in later:
            run(line, tmp_path)
    assert list(passwords) == ["goob", "fred", "minilamp", "ann", "otto"]
    search = ["grep", "-rlE", "|".join(passwords.values()), str(tmp_path / "hall")]
    assert subprocess.run(search, check=False, capture_output=True).stdout == b""  # no file has one of them


def run(line: str, folder: Path) -> str:
    """What a line prints that succeeds without a complaint."""
    done = pebble(line, folder)
    assert (done.returncode, done.stderr) == (0, ""), (line, done)
    return done.stdout


@contextmanager
def typed(line: str, folder: Path) -> Iterator[None]:
    """A program that runs until it is ended."""
    with (folder / "simulation.log").open("ab") as log:
        process = Child(python("pebble.cli", *shlex.split(line)[1:]), cwd=folder, stdout=log, stderr=log)
    try:
        yield
    finally:
        process.terminate()
        process.wait(10)


def _merged(piece: dict[str, Any], folder: Path) -> Path:
    """The piece that was printed in a copy of the config of its kind, with a copy of the authority beside it."""
    kind = {True: "minilamp", False: "minimal"}["local_mqtt" in piece]
    (folder / "ca.pem").write_bytes((folder / "hall" / "ca.pem").read_bytes())
    return _written(deep_merge(json.loads((ROOT / "configs" / f"{kind}.json").read_text()), piece), folder, kind)


def _written(config: dict[str, Any], folder: Path, name: str) -> Path:
    file = folder / f"{name}.json"
    file.write_text(json.dumps(config))
    file.chmod(0o600)
    return file


def _robot_accepts(file: Path, level: str) -> None:
    config = load(file)
    assert (config.security.level, config.warnings) == (level, ())


@pytest.fixture(scope="module")
def new(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("new")
    run(f"pebble fleet init hall --host 127.0.0.1 --port {free_port()} --board-port {free_port()}", folder)
    return folder


@pytest.fixture
def hall(new: Path, tmp_path: Path) -> Path:
    shutil.copytree(new, tmp_path, dirs_exist_ok=True)
    conf = tmp_path / "hall" / CONF
    conf.write_text(conf.read_text().replace(str(new), str(tmp_path)))
    return tmp_path


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("pebble fleet init hall --host x.lab", "hall is a fleet already, so leave out --host"),
        ("pebble fleet init other", "--host is missing: the name or address by which robots and people reach"),
        ("pebble fleet init other --host x.lab --level open", '--level must be "login" or "named", not "open"'),
        ("pebble fleet add Ann --role driver", "'Ann' is no name: use 1 to 32 of a-z, 0-9, _ and -"),
        ("pebble fleet role otto driver", "hall/fleet.json has no account 'otto': `pebble fleet list` lists them"),
        ("pebble fleet remove otto", "hall/fleet.json has no account 'otto'"),
        ("pebble fleet list --folder nowhere", "nowhere/fleet.json: `pebble fleet init"),
    ],
)
def test_a_refusal_names_the_remedy(hall: Path, line: str, error: str) -> None:
    done = pebble(line, hall)
    assert (done.returncode, done.stdout) == (1, "")
    assert error in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_without_a_fleet_or_with_several_one_must_be_named(hall: Path) -> None:
    done = pebble("pebble fleet list", hall / "hall" / "..")
    assert done.returncode == 0
    (hall / "empty").mkdir()
    assert "there is no fleet here: name one with --folder FOLDER" in pebble("pebble fleet list", hall / "empty").stderr
    pebble(f"pebble fleet init second --host 127.0.0.1 --port {free_port()}", hall)
    assert "there are several fleets here, hall, second" in pebble("pebble fleet list", hall).stderr
    assert pebble("pebble fleet list --folder second", hall).returncode == 0


def test_removing_a_person_acts_on_pages_here_and_names_those_elsewhere(hall: Path) -> None:
    people = People(hall / "people.sqlite")
    people.add("ann", "a long password", Role.DRIVER)
    pebble("pebble fleet add ann --role driver", hall)
    pebble("pebble fleet add page-1 --role page --people people.sqlite", hall)
    done = pebble("pebble fleet remove ann", hall)
    assert (done.returncode, done.stderr) == (0, "")
    assert people.list() == []
    people.close()
    pebble("pebble fleet add ann --role driver", hall)
    pebble("pebble fleet add page-2 --role page", hall)
    done = pebble("pebble fleet remove ann", hall)
    assert done.returncode == 1
    assert "page-2 has people of its own: if ann is one, `pebble web user remove ann` on its machine" in done.stderr
    assert pebble("pebble fleet remove page-2", hall).returncode == 0


def test_a_broker_that_no_command_reaches_is_named_at_each_change_that_takes_something_away(tmp_path: Path) -> None:
    """A second broker has copies of the files."""
    port = free_port()
    run(f"pebble fleet init hall --host 127.0.0.1 --port {port}", tmp_path)
    run("pebble fleet add ann --role driver", tmp_path)
    file = tmp_path / "hall" / FLEET
    fleet = json.loads(file.read_text())
    file.write_text(json.dumps(fleet | {"brokers": [*fleet["brokers"], {"host": "spare.lab", "port": 8884}]}))
    for line in ("role ann viewer", "password ann", "apply", "remove ann"):
        done = pebble(f"pebble fleet {line}", tmp_path)
        assert done.returncode == 1, line
        assert "broker spare.lab:8884 obeys its copies of hall/acl and passwords: copy them again" in done.stderr


@pytest.mark.thorough
def test_zenoh_hubs_have_the_same_accounts(hall: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is printed for a robot makes a valid config."""
    rules = hall / "hall" / ZENOH
    for line in ("add ann --role driver", "add goob --role robot", "zenoh", "certificate ann"):
        run(f"pebble fleet {line}", hall)
    for host in ("LocalHost.", "127.0.0.1", "Ann"):
        assert "another account" in pebble(f"pebble fleet certificate goob {host}", hall).stderr
    printed = run("pebble fleet certificate goob goob.local 10.0.0.7", hall)
    for name in ("goob.pem", "goob.key"):
        (hall / "hall" / "accounts" / name).rename(hall / name)
    piece = json.loads(printed[printed.index("{") :])
    (hall / "ca.pem").write_bytes((hall / "hall" / "ca.pem").read_bytes())
    _robot_accepts(_written({"robot": {"id": "goob"}, **piece}, hall, "goob"), "login")
    assert set(read_access(rules).accounts) == {"ann", "goob"}
    run("pebble fleet add hub1 --role hub", hall)
    assert "name where others reach it" in pebble("pebble fleet certificate hub1", hall).stderr
    printed = run("pebble fleet certificate hub1 hub1.local", hall)
    for name in ("hub1.pem", "hub1.key"):
        (hall / "hall" / "accounts" / name).rename(hall / name)
    (hall / "hub1.json").write_text(printed[printed.index("{") :])
    assert load_hub(hall / "hub1.json").access == hall / ZENOH
    assert pebble("pebble fleet remove hub1", hall).returncode == 1
    done = pebble("pebble fleet remove ann", hall)
    assert (done.returncode, set(read_access(rules).accounts)) == (1, {"goob"})
    assert "Zenoh hubs obey their copies of hall/zenoh.json: copy it again" in done.stderr
    run("pebble fleet zenoh --only-here", hall)
    run("pebble fleet remove goob", hall)
    assert set(read_access(rules).accounts) == set()
    run("pebble fleet add boss --role admin", hall)
    monkeypatch.setattr(authority, "SERVER_DAYS", 20)
    for name in ("boss", "gone"):
        certificates.of_account(hall / "hall", name)
    rules.write_bytes(rules.read_bytes().replace(b"incoming/estop", b"incoming/#"))
    problems = pebble("pebble fleet check", hall).stderr
    assert "zenoh.json does not hold the rules of the table" in problems
    assert "boss.pem ends in 20 days: `pebble fleet certificate boss`" in problems
    assert "gone.pem" not in problems
