"""Steps are done once, survive being killed, keep what was written by hand, and follow no links of others as root."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from pebble.extensions.install.commands import setup as command
from pebble.extensions.install.setup import system
from pebble.extensions.install.setup.robot_config import changed
from pebble.extensions.install.setup.system import MOSQUITTO, ROBOT, ROBOTS, SetupError, System
from pebble.extensions.operator.places import Places
from tests.commands.command_line import Run
from tests.ext.install.setup.conftest import ANSWERS, PASSWORD, answers_in, in_child, machine_root, set_up, tree
from tests.support import cases, needs_root

_MOMENTS = cases(6, 110)
RESTARTS = ["systemctl restart mosquitto.service", "systemctl restart pebble.service"]


def test_a_second_run_finds_all_as_it_should_be(root: Path, tmp_path: Path, run: Run) -> None:
    answers = answers_in(tmp_path)
    (root / "usr/lib/polkit-1/polkitd").unlink()
    assert run("setup", "--answers", answers) == 1
    assert run.out.count("Failed: systemd does not run here, so nothing starts the robot") == 1
    assert run.out.count("Note: polkit is not installed") == 1
    before = tree(root)
    assert run("setup", "--answers", answers) == 1
    assert "All is so already." in run.out
    assert tree(root) == before


def test_killed_at_any_moment_it_goes_on_and_ends_with_the_same_tree(tmp_path: Path) -> None:
    whole = machine_root(tmp_path / "whole")
    (whole / "run/systemd/system").mkdir(parents=True)
    status, changes = in_child(lambda: set_up(whole), below=whole)
    assert status == 0
    expected = tree(whole)
    for moment in range(_MOMENTS):
        root = machine_root(tmp_path / str(moment))
        (root / "run/systemd/system").mkdir(parents=True)
        at = 1 + moment * (changes - 1) // (_MOMENTS - 1)
        status, _ = in_child(lambda root=root: set_up(root), kill_at=at, below=root)  # type: ignore[misc]
        assert os.waitstatus_to_exitcode(status) == -signal.SIGKILL, at
        ran: list[str] = []
        set_up(root, ran)
        left = {path for path in tree(root) if Path(path).name.startswith(".") and path.endswith(".new")}
        assert {path: shown for path, shown in tree(root).items() if path not in left} == expected, f"{at} of {changes}"
        assert ran[-2:] == RESTARTS, f"{at} of {changes}"


def test_services_are_started_anew_for_what_they_read(root: Path) -> None:
    (root / "run/systemd/system").mkdir(parents=True)
    wants = root / "etc/systemd/system/multi-user.target.wants"
    wants.mkdir(parents=True)
    ran: list[str] = []
    set_up(root, ran)
    assert ran == ["systemctl enable pebble.service", *RESTARTS]
    (wants / "pebble.service").touch()
    assert set_up(root, ran) == []
    assert set_up(root, ran, camera="none") == ["config /etc/pebble/robot.json"]
    assert ran[3:] == RESTARTS[1:]
    Places(root).unfinished.touch()
    set_up(root, ran)
    assert ran[4:] == RESTARTS, "it was killed before"


def test_one_other_answer_changes_what_depends_on_it_and_leaves_what_was_written_by_hand(root: Path) -> None:
    set_up(root)
    config = Places(root).config
    content = json.loads(config.read_text())
    content["services"]["av_daemon"]["audio"] = {"enabled": True}
    content["services"]["av_daemon"]["video"]["width"] = 320
    content["services"]["recorder"] = {"enabled": True}
    config.write_text(json.dumps(content))
    assert set_up(root) == []
    set_up(root, camera="/dev/video7")
    set_up(root, camera="none", port="none")
    services = json.loads(config.read_text())["services"]
    assert services["av_daemon"] == {"enabled": False, "audio": {"enabled": True}, "video": {"width": 320}}
    assert services["serial_mcu_bridge"] == {"enabled": False, "serial": {}}
    assert services["recorder"] == {"enabled": True}
    assert json.loads(config.with_name("robot.json.before").read_text())["services"]["av_daemon"]["enabled"]
    set_up(root, **{key: ANSWERS[key] for key in ("camera", "port", "protocol")})
    before = {key: value for key, value in content.items() if key != "//"}
    assert before == {key: value for key, value in json.loads(config.read_text()).items() if key != "//"}


@pytest.mark.parametrize(
    ("current", "before", "after", "result"),
    [
        ({"a": 1}, {"a": 1}, {"a": 2}, {"a": 2}),
        ({"a": 3}, {"a": 1}, {"a": 1}, {"a": 3}),
        ({"a": 3}, {"a": 1}, {"a": 2}, {"a": 2}),
        ({"a": 1, "b": 5}, {"a": 1}, {}, {"b": 5}),
        ({"a": 3, "b": 5}, {"a": 1}, {}, {"a": 3, "b": 5}),
        ({}, {"a": 1}, {"a": 1, "c": 2}, {"c": 2}),
        ({"a": {"b": 1, "c": 2}}, {"a": {"b": 1}}, {"a": {"b": 3}}, {"a": {"b": 3, "c": 2}}),
        ({"a": {"b": 1, "c": 2}}, {"a": {"b": 1}}, {}, {"a": {"c": 2}}),
        ({"a": {"c": 2}}, {}, {"a": {"b": 1}}, {"a": {"b": 1, "c": 2}}),
    ],
)
def test_a_change_of_a_config(
    current: dict[str, object], before: dict[str, object], after: dict[str, object], result: dict[str, object]
) -> None:
    assert changed(current, before, after) == result


def test_the_own_broker_ends_with_another_answer_and_comes_back(root: Path) -> None:
    set_up(root)
    password = (Places(root).etc / "broker.password").read_text()
    set_up(root, broker="none", page=False)
    assert not Places(root).broker.exists()
    set_up(root, broker="here", page=True)
    assert Places(root).broker.exists()
    assert (Places(root).etc / "broker.password").read_text() != password
    assert set_up(root) == []


def test_a_disk_that_takes_nothing_is_one_line(root: Path) -> None:
    Places(root).state.rmdir()
    Places(root).state.symlink_to("/dev/full")
    with pytest.raises(SetupError, match=r"\A[^\n]+; what was done until then stays, and sudo pebble setup goes on "):
        set_up(root)


def test_no_password_is_shown_or_stored_but_where_it_belongs(root: Path, tmp_path: Path, run: Run) -> None:
    run("setup", "--answers", answers_in(tmp_path))
    places = Places(root)
    secrets = [PASSWORD, *((places.etc / f"{name}.password").read_text().strip() for name in ("broker", "page"))]
    shown = [secret for secret in secrets if secret in run.out + run.err]
    holders = {
        str(path.relative_to(root))
        for path in root.rglob("*")
        if path.is_file() and any(secret.encode() in path.read_bytes() for secret in secrets)
    }
    assert shown == []
    assert holders == {"etc/pebble/broker.password", "etc/pebble/page.password"}
    assert len(set(secrets)) == 3


# -- as root


OWNERS = {ROBOTS: (0, 65534), ROBOT: (65534, 65534), MOSQUITTO: (1, 1)}
_ACTS = (
    "open",
    "sqlite3.connect",
    "os.chmod",
    "os.chown",
    "os.mkdir",
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.symlink",
)
_watched: list[str] = []  # folders
_acts: set[str] = set()


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    if _watched and event in _ACTS and os.geteuid() == 0:
        paths = [str(path).removeprefix("file://") for path in arguments[:2]]
        _acts.update(f"{event} {path}" for path in paths if path.startswith(tuple(_watched)))


@contextmanager
def watched(*roots: Path) -> Iterator[None]:
    _acts.clear()
    _watched[:] = [f"{folder}/" for root in roots for folder in (Places(root).state, Places(root).broker_folder)]
    try:
        yield
    finally:
        _watched.clear()


@needs_root
def test_in_folders_of_others_root_is_their_owner(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sys.addaudithook(_watch)
    run = Run(monkeypatch, capsys)
    with TemporaryDirectory() as name:
        place = Path(name)
        place.chmod(0o755)
        here, other = (machine_root(place / folder) for folder in ("here", "other"))
        for root in (here, other):
            os.chown(Places(root).state, *OWNERS[ROBOT])
        people, hall = Places(here).people, Places(here).broker_folder

        def at(root: Path) -> None:
            monkeypatch.setattr(system, "System", lambda: System(Places(root), run=print, owner=OWNERS.get))
            monkeypatch.setattr(command, "Places", lambda: Places(root))

        at(here)
        with watched(here, other):
            run("setup", "--answers", answers_in(place))
            run("setup", "--answers", answers_in(place, camera="none", user="bob"))
            for words in (("list",), ("add", "ann", "--role", "viewer"), ("role", "ann", "driver")):
                assert run("fleet", *words, "--folder", hall) == 0, run.err
            for words in (
                ("add", "p", "--role", "page", "--people", people),
                ("certificate", "ann"),
                ("password", "ann"),
            ):
                assert run("fleet", *words, "--folder", hall) == 0, run.err
            run("fleet", "check", "--folder", hall)
            run("fleet", "remove", "ann", "--folder", hall)
            assert "ann is removed from the people of p and logged out there" in run.out, run.err
            assert run("web", "user", "list", "--people", people) == 0, run.err
            assert run.out.split() == ["bob", "admin"]
            assert run("web", "audit", "--people", people) == 0
            assert run("fleet", "audit", Places(here).config) == 0
            for words in (("init", "a.local"), ("renew",), ("show",)):
                assert run("cert", *words, "--folder", people.parent / "tls") == 0, run.err
            assert run("recordings", "mend", people.parent) == 0, run.err
            assert run("setup", "--backup", place / "goob.tar") == 0, run.err
            at(other)
            run("setup", "--from", place / "goob.tar")
        assert not _acts
        assert {Places(root).config.stat().st_gid for root in (here, other)} == {OWNERS[ROBOTS][1]}
        assert (people.parent / "tls/ca.key").stat().st_uid == OWNERS[ROBOT][0]
        assert Places(other).people.stat().st_uid == OWNERS[ROBOT][0]
        assert {path.lstat().st_uid for path in Places(other).broker_folder.iterdir()} == {OWNERS[MOSQUITTO][0]}
        assert {path.stat().st_gid for path in Places(here).etc.iterdir()} == {OWNERS[ROBOTS][1]}, "the robot reads it"
