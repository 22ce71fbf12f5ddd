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
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from pebble.config import load
from pebble.config.raw import deep_merge
from pebble.extensions.fleet import authority, certificates
from pebble.extensions.fleet.files import load_hub
from pebble.extensions.fleet.folder import FLEET, ZENOH
from pebble.extensions.fleet.hub_access import read_access
from pebble.extensions.fleet.people import People
from pebble.extensions.fleet.robot_audit import ROBOT, files
from pebble.extensions.fleet.roles import Role
from pebble.extensions.lab.rig.processes import python
from pebble.extensions.operator.places import mosquitto_path
from tests.commands.command_line import Run, running
from tests.ext.fleet.brokers import BrokerClient, Place
from tests.kit.terminal import Terminal
from tests.services.mqtt_bridge.bridge_rig import MemoryRig, make_config
from tests.support import ROOT, WAIT_S, Child, free_port, listening, until

PAGE = (ROOT / "docs/ext/fleet.md").read_text()
#: The first block of the page: what a newcomer types, one after the other.
FIRST = re.findall(r"^    (\S.*)$", PAGE.partition("## ")[2].partition("## ")[0], re.MULTILINE)
LAMP = "pebble/robots/minilamp"
MOVES = re.compile(rb'"z": ?0\.[1-9]')
PASSWORD = re.compile(r"password: ((?:[a-z0-9]{4}-){3}[a-z0-9]{4})")


def words(line: str) -> list[str]:
    """Return the arguments of a line that begins with ``pebble``."""
    first, *arguments = shlex.split(line, comments=True)
    assert first == "pebble"
    return arguments


def pebble(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a line that begins with ``pebble``, in this folder."""
    command = [sys.executable, "-m", "pebble.cli", *words(line)]
    env = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_STATE_HOME": str(folder / "state")}
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False, timeout=60)


@contextmanager
def started(command: list[str], folder: Path) -> Iterator[None]:
    """A program that runs until it is ended."""
    with (folder / "log").open("ab") as log:
        process = Child(command, cwd=folder, stdout=log, stderr=log)
    try:
        yield
    finally:
        process.terminate()
        process.wait(WAIT_S)


@pytest.mark.parametrize("level", ["login", "named"])
def test_the_first_page_as_a_newcomer_types_it(
    level: str, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The host is this machine instead of the broker's, and the port a free one: nothing else differs."""
    port, passwords = free_port(), dict[str, str]()
    init, start, *accounts, check = FIRST[:8]
    simulate, drive, stop, *later = (line.replace("broker.lab:8883", f"127.0.0.1:{port}") for line in FIRST[8:])
    monkeypatch.chdir(tmp_path)

    def shown_by(line: str) -> str:
        assert (run(*words(line)), run.err) == (0, ""), line
        return run.out

    shown = shown_by(init.replace("broker.lab", f"127.0.0.1 --port {port} --level {level}"))
    assert shown.count(start.split("  ")[0]) == 1
    with started([str(mosquitto_path()), *start.split()[1:3]], tmp_path):
        assert until(lambda: listening(port)), (tmp_path / "log").read_text()
        for line in accounts:
            shown = shown_by(line)
            passwords[line.split()[3]] = PASSWORD.findall(shown)[0]
            for piece in re.findall(r"^\{.*^\}", shown, re.DOTALL | re.MULTILINE):
                _robot_accepts(_merged(json.loads(piece), tmp_path), level)
        assert "have its 5 accounts, and their rules" in shown_by(check)
        for name, password in passwords.items():
            (tmp_path / f"{name}-password").write_text(f"{password}\n")
        place = Place("127.0.0.1", port, tmp_path / "hall" / "ca.pem")
        simulation = started(python("pebble.cli", *words(simulate)), tmp_path)
        with BrokerClient(place, "minilamp", passwords["minilamp"]) as robot, simulation:
            robot.subscribe([f"{LAMP}/incoming/#", f"{LAMP}/outgoing/estop/#"])
            with closing(Terminal(*python("pebble.cli", *shlex.split(drive)[1:]), cwd=tmp_path)) as console:
                assert console.sees("ready"), console.shown
                console.hold(b"w")
                assert until(lambda: robot.listen(0.05) or any(MOVES.search(one) for _, one in robot.received))
            assert "stopped and confirmed" in shown_by(stop)
            assert until(lambda: robot.listen(0.05) or any(b'"latched":true' in one for _, one in robot.received))
        for line in later:
            shown_by(line)
    assert list(passwords) == ["goob", "fred", "minilamp", "ann", "otto"]
    search = ["grep", "-rlE", "|".join(passwords.values()), str(tmp_path / "hall")]
    assert subprocess.run(search, check=False, capture_output=True).stdout == b""  # no file has one of them


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


@pytest.fixture
def hall(tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a fleet, where all is typed."""
    monkeypatch.chdir(tmp_path)
    ports = ("--port", free_port(), "--board-port", free_port())
    assert run("fleet", "init", "hall", "--host", "127.0.0.1", *map(str, ports)) == 0
    return tmp_path


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("pebble fleet init hall --host x.lab", "hall is a fleet already, so leave out --host"),
        ("pebble fleet init other", "--host is missing: the name or address by which robots and people reach"),
        ("pebble fleet init other --host x.lab --level open", '--level must be "login" or "named", not "open"'),
        ("pebble fleet add Ann --role driver", "'Ann' is no name: use 1 to 32 of a-z, 0-9, _ and -"),
        ("pebble fleet role otto driver", "hall/fleet.json has no account 'otto': `pebble fleet list` lists them"),
        ("pebble fleet list --folder nowhere", "nowhere/fleet.json: `pebble fleet init"),
    ],
)
@pytest.mark.usefixtures("hall")
def test_a_refusal_names_the_remedy(run: Run, line: str, error: str) -> None:
    assert (run(*words(line)), run.out) == (1, "")
    assert error in run.err
    assert len(run.err.splitlines()) == 1


def test_removing_a_person_acts_on_pages_here_and_names_those_elsewhere(hall: Path, run: Run) -> None:
    with closing(People(hall / "people.sqlite")) as people:
        people.add("ann", "a long password", Role.DRIVER)
        run("fleet", "add", "ann", "--role", "driver")
        run("fleet", "add", "page-1", "--role", "page", "--people", "people.sqlite")
        assert (run("fleet", "remove", "ann"), run.err) == (0, "")
        assert people.list() == []
    run("fleet", "add", "ann", "--role", "driver")
    run("fleet", "add", "page-2", "--role", "page")
    assert run("fleet", "remove", "ann") == 1
    assert "page-2 has people of its own: if ann is one, `pebble web user remove ann` on its machine" in run.err
    assert run("fleet", "remove", "page-2") == 0


def test_a_broker_that_no_command_reaches_is_named_at_each_change_that_takes_something_away(
    hall: Path, run: Run
) -> None:
    """A second broker has copies of the files."""
    run("fleet", "add", "ann", "--role", "driver")
    file = hall / "hall" / FLEET
    fleet = json.loads(file.read_text())
    file.write_text(json.dumps(fleet | {"brokers": [*fleet["brokers"], {"host": "spare.lab", "port": 8884}]}))
    for line in ("role ann viewer", "password ann", "apply", "remove ann"):
        assert run("fleet", *line.split()) == 1, line
        assert "broker spare.lab:8884 obeys its copies of hall/acl and passwords: copy them again" in run.err


@pytest.mark.thorough
def test_zenoh_hubs_have_the_same_accounts(hall: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is printed for a robot makes a valid config."""
    rules = hall / "hall" / ZENOH

    def fleet(line: str, code: int = 0) -> str:
        assert run("fleet", *line.split()) == code, run.err
        return run.out if code == 0 else run.err

    for line in ("add ann --role driver", "add goob --role robot", "zenoh", "certificate ann"):
        fleet(line)
    for host in ("LocalHost.", "127.0.0.1", "Ann"):
        assert "another account" in fleet(f"certificate goob {host}", 1)
    printed = fleet("certificate goob goob.local 10.0.0.7")
    for name in ("goob.pem", "goob.key"):
        (hall / "hall" / "accounts" / name).rename(hall / name)
    piece = json.loads(printed[printed.index("{") :])
    (hall / "ca.pem").write_bytes((hall / "hall" / "ca.pem").read_bytes())
    _robot_accepts(_written({"robot": {"id": "goob"}, **piece}, hall, "goob"), "login")
    assert set(read_access(rules).accounts) == {"ann", "goob"}
    fleet("add hub1 --role hub")
    assert "name where others reach it" in fleet("certificate hub1", 1)
    printed = fleet("certificate hub1 hub1.local")
    for name in ("hub1.pem", "hub1.key"):
        (hall / "hall" / "accounts" / name).rename(hall / name)
    (hall / "hub1.json").write_text(printed[printed.index("{") :])
    assert load_hub(hall / "hub1.json").access == hall / ZENOH
    fleet("remove hub1", 1)
    assert "Zenoh hubs obey their copies of hall/zenoh.json: copy it again" in fleet("remove ann", 1)
    assert set(read_access(rules).accounts) == {"goob"}
    fleet("zenoh --only-here")
    fleet("remove goob")
    assert set(read_access(rules).accounts) == set()
    fleet("add boss --role admin")
    monkeypatch.setattr(authority, "SERVER_DAYS", 20)
    for name in ("boss", "gone"):
        certificates.of_account(hall / "hall", name)
    rules.write_bytes(rules.read_bytes().replace(b"incoming/estop", b"incoming/#"))
    problems = fleet("check", 1)
    assert "zenoh.json does not hold the rules of the table" in problems
    assert "boss.pem ends in 20 days: `pebble fleet certificate boss`" in problems
    assert "gone.pem" not in problems


@pytest.mark.thorough
def test_two_robots_of_a_lan_and_a_board_receive_each_other_in_six_commands(tmp_path: Path) -> None:
    """The commands and the file of docs/many.md as printed; only the ports are others."""
    hub, port = free_port(), free_port()
    text = (ROOT / "docs/many.md").read_text().partition("\n## A LAN with boards\n")[2].partition("\n## ")[0]
    make, *starts, _ = re.findall(r"^    (pebble .*)$", text.replace("hub.lab", "127.0.0.1"), re.MULTILINE)
    made = pebble(f"{make} --port {port}", tmp_path)
    assert (made.returncode, made.stderr) == (0, "")
    lan = tmp_path / "lan"
    (grants,) = re.findall(r"```jsonc\n//[^\n]*\n(.*?)```", text, re.DOTALL)
    gateway = lan / "gateway.json"
    gateway.write_text(json.dumps(deep_merge(json.loads(gateway.read_text()), json.loads(grants))))
    for file in lan.glob("**/*.json"):
        if file.name not in ("fleet.json", "zenoh.json"):
            file.write_text(file.read_text().replace("0.0.0.0:7447", "127.0.0.1:7447").replace("7447", str(hub)))
    for file in lan.glob("robots/*/*"):
        shutil.copy(file, tmp_path)

    def receives_both() -> bool:
        shown = pebble("pebble topic echo neighbours -c goob.json --raw -n 1 -s 5", tmp_path).stdout
        return bool(shown) and json.loads(shown)["receives"] == {"fred": True, "minilamp": True}

    with ExitStack() as stack:
        for line in starts:
            stack.enter_context(started(python("pebble.cli", *words(line)), tmp_path))
            assert until(lambda: listening(hub), 60), (tmp_path / "log").read_text()
        assert until(receives_both, 60), (tmp_path / "log").read_text()


def test_a_bridge_notes_what_passes_and_a_command_prints_it(
    monkeypatch: pytest.MonkeyPatch, run: Run, tmp_path: Path
) -> None:
    rig, stop = MemoryRig(monkeypatch), "0123456789abcdef"
    try:
        rig.bridge()
        path, older = files(make_config())
        rig.remote.publish("incoming/estop", json.dumps({"stop": stop, "by": "ann"}).encode())
        rig.remote.publish("incoming/autonomy-command", b'{"action": "stop"}', retain=True)  # live, though retained
        rig.local.publish("incoming/autonomy-command", b'{"action": "start", "file": "a"}')
        assert until(lambda: path.exists() and path.read_bytes().count(b"\n") == 4), path.read_text()
    finally:
        rig.close()
    with path.open("ab") as file:
        file.write(b'{"t": "x"}\n\n[1]\n{"t":1e99}\n{"t":1,"what":"stop","count":9,"by":"\\u001b[2J"}\n')
    older.write_bytes(b'{"t":0,"what":"first"}\n')
    robot = tmp_path / "rover.json"
    robot.write_text(json.dumps({"robot": {"id": "rover"}, "services": {}}))
    assert run("fleet", "audit", robot, columns=200) == 0
    lines = [line.rstrip() for line in run.out.splitlines()]
    assert [line.split()[2] for line in lines[1:4]] == ["first", "stop", "start"], "by time, not as stored"
    shown = [line.split()[2:] for line in lines[4:7]]  # of two connections
    assert ["stop", "ann?", "operators", "stop", stop] in shown
    assert ["script-start", ROBOT, "robot", "file", "a"] in shown
    assert {row[0] for row in shown} == {"stop", "script-start", "refused"}
    assert "× 9" in lines[2]
    assert lines[2].endswith(r"by \u001b[2J")
    assert lines[8].startswith("3 lines cannot be read")
    assert run("fleet", "audit", robot, "-n", "1") == 0
    assert ("× 9" in run.out, run.out.count("\n")) == (True, 3)


# -- files of gateways and hubs


HUB = {"connect": ["tcp/127.0.0.1:1"]}
BOARDS = {"id": "g", "hub": {}, "boards": {}}


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({}, "gate.json: id: is missing: write what this gateway is called, such as gate-1"),
        ({"id": "a/b"}, "gate.json: id: must be a topic level"),
        ({"id": "g", "hub": {}}, "gate.json: hub.connect: is missing: write where the hub listens"),
        ({"id": "g", "mqtt": {"hosts": ["a", "b"]}}, "gate.json: mqtt: hosts is no key any more"),
        ({"id": "g", "robots": []}, "gate.json: robots: is empty"),
        ({"id": "g", "robots": ["pebble/gateways/+"]}, "'pebble/gateways/+' is no base"),
        ({"id": "g", "boards": {}}, "gate.json: boards: must be left out beside hub"),
        ({"id": "g", "hub": {}, "boards": {"host": "localhost"}}, "gate.json: mqtt: is also boards"),
        ({"id": "g", "neighbours": {LAMP: {"lan": HUB}}}, "gate.json: neighbours: must be left out without boards"),
        ({**BOARDS, "neighbours": {"pebble/robots/+": {"lan": HUB}}}, "'pebble/robots/+' is no base"),
        ({**BOARDS, "neighbours": {LAMP: {}}}, f"gate.json: neighbours.{LAMP}.lan.connect: is missing"),
        ({**BOARDS, "neighbours": {LAMP: {"lan": HUB, "listens": {"a": []}}}}, f"{LAMP}.listens: must be left out"),
        ({**BOARDS, "neighbours": {f"a/b/c{n}": {"lan": HUB} for n in range(17)}}, "has 17 robots: 16 are the most"),
    ],
)
def test_a_gateway_that_cannot_work_is_refused(
    run: Run, tmp_path: Path, settings: dict[str, Any], complaint: str
) -> None:
    assert run("fleet", "gateway", _written({"hub": HUB, **settings}, tmp_path, "gate")) == 1
    assert complaint in run.err


def test_a_hub_names_where_it_listens(tmp_path: Path) -> None:
    settings = {"run_dir": str(tmp_path / "a"), "listen": [f"tcp/127.0.0.1:{free_port()}"], "journal": "a.journal"}
    with running("fleet", "hub", _written(settings, tmp_path, "a")):
        assert until((tmp_path / "a" / "hub.sock").exists)


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({}, 'hub.json: listen: is missing: a hub is reached there, such as ["tls/0.0.0.0:7447"]'),
        ({"listen": ["tcp/127.0.0.1:1"], "lisen": []}, 'hub.json: lisen: unknown key, did you mean "listen"?'),
        ({"listen": ["tcp/127.0.0.1:1"], "max_wills": 0}, "hub.json: max_wills: "),
        ({"listen": ["tcp/192.0.2.1:7447"]}, "leaves this machine unencrypted: use tls/host:port"),
    ],
)
def test_a_hub_that_cannot_work_is_refused(run: Run, tmp_path: Path, settings: dict[str, Any], complaint: str) -> None:
    assert run("fleet", "hub", _written({"run_dir": str(tmp_path / "hub"), **settings}, tmp_path, "hub")) == 1
    assert complaint in run.err
