"""Steps are done once, survive being killed, keep what was changed by hand, and can be undone."""

from __future__ import annotations

import json
import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.fleet.people import People
from pebble.setup import manifest
from pebble.setup.manifest import Manifest
from pebble.setup.places import Places
from pebble.setup.steps import Engine, State, Step
from tests.commands.command_line import Run
from tests.setup.rig import PASSWORD, answers_in, in_child, machine_root, manifest_is_true, set_up, tree, without_rights
from tests.support import cases, needs_root

_MOMENTS = cases(6, 20)
_LIVE = {
    "user pebble",
    "mosquitto starts with its part",
    "the robot starts with the machine",
    "the robot runs with this config",
}


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that all users read, unlike those of pytest."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        yield folder


def states(out: str) -> list[str]:
    """The first column of a listing."""
    words = [line[:15].strip() for line in out.splitlines()]
    return [word for word in words if word in list(State)]


def test_a_second_run_finds_all_the_same(root: Path, answers: Path, run: Run) -> None:
    assert run("setup", "--root", root, "--answers", answers, "--yes") == 0
    before = tree(root)
    assert run("setup", "--root", root, "--answers", answers, "--yes") == 0
    assert set(states(run.out)) == {State.SAME, State.SKIPPED}
    assert "nothing: all was so before" in run.out
    assert run("setup", "--root", root, "--yes") == 0, "the answers of the last time count"
    assert tree(root) == before
    assert manifest_is_true(root)


@needs_root
def test_a_dry_run_of_an_ordinary_user_names_each_step_and_writes_nothing(open_folder: Path, run: Run) -> None:
    root = machine_root(open_folder)
    answers = answers_in(open_folder)
    for file in open_folder.glob("a*"):
        file.chmod(0o644)
    before = tree(root)
    line = ("setup", "--root", root, "--answers", answers, "--dry-run")
    assert run(*line) == 0
    named = states(run.out)
    assert named.count(State.NEW) == 12
    assert named.count(State.SKIPPED) == len(_LIVE)
    assert tree(root) == before
    set_up(root)
    done = tree(root)

    def again() -> str:
        return f"{run(*line)} {run.err}\n{run.out}"

    shown = without_rights(again)
    assert shown.startswith("0 \n"), shown
    assert len(states(shown)) == len(named)
    assert tree(root) == done


def test_killed_at_any_moment_it_goes_on_and_ends_with_the_same_tree(tmp_path: Path) -> None:
    whole = machine_root(tmp_path / "whole")
    status, changes = in_child(lambda: set_up(whole), below=whole)
    assert status == 0
    expected = tree(whole)
    for moment in range(_MOMENTS):
        root = machine_root(tmp_path / str(moment))
        at = 1 + moment * (changes - 1) // (_MOMENTS - 1)
        status, _ = in_child(lambda root=root: set_up(root), kill_at=at, below=root)  # type: ignore[misc]
        assert os.waitstatus_to_exitcode(status) == -signal.SIGKILL, at
        set_up(root)
        assert tree(root) == expected, f"killed before change {at} of {changes}"
        assert manifest_is_true(root), at


def test_undo_leaves_the_tree_of_before_but_state(root: Path, run: Run) -> None:
    before = tree(root)
    set_up(root)
    assert run("setup", "--root", root, "--undo", "--dry-run") == 0
    assert "remove /etc/pebble/robot.json" in run.out
    assert run("setup", "--root", root, "--undo", "--yes") == 0
    after = tree(root)
    state = {"var/lib/pebble": after["var/lib/pebble"], "var/lib/pebble/people.sqlite": ("-rw-------", b"")}
    assert after == before | state
    set_up(root, user="eve")
    with_both = People(Places(root).people)
    assert [user.name for user in with_both.list()] == ["ann", "eve"]
    with_both.close()


def test_what_was_changed_by_hand_stays_and_is_named(root: Path, run: Run) -> None:
    set_up(root)
    config = Places(root).config
    by_hand = config.read_text().replace("synthetic", "libcamera")
    config.write_text(by_hand)
    assert run("setup", "--root", root, "--yes", "--port", "none") == 0
    assert "robot.json was changed by hand and stays: ours is /etc/pebble/robot.json.pebble-new" in run.out
    assert config.read_text() == by_hand
    ours = json.loads(config.with_name("robot.json.pebble-new").read_text())
    assert "serial_mcu_bridge" not in ours["services"]
    assert run("setup", "--root", root, "--undo", "--yes") == 0
    assert "changed by hand  /etc/pebble/robot.json stays" in run.out
    assert sorted(path.name for path in config.parent.iterdir()) == ["robot.json"]


def test_a_purge_erases_keys_people_state_and_what_was_changed(root: Path, run: Run) -> None:
    before = tree(root)
    set_up(root)
    places = Places(root)
    places.config.write_text(places.config.read_text() + "\n")
    set_up(root, camera="none")
    assert places.config.with_name("robot.json.pebble-new").exists()
    (places.state / "estop-serial-pebble+robots+goob.json").write_text("{}")
    assert run("setup", "--root", root, "--undo", "--purge", "--yes") == 0
    assert tree(root) == before


@pytest.mark.parametrize(
    ("changes", "gone"),
    [
        ({"page": False}, "etc/pebble/page.password etc/pebble/tls etc/pebble/tls/ca.key"),
        ({"broker": "none", "page": False}, "etc/mosquitto/conf.d/pebble.conf etc/mosquitto/pebble"),
    ],
)
def test_what_other_answers_do_not_need_is_removed(root: Path, changes: dict[str, object], gone: str) -> None:
    set_up(root)
    set_up(root, **changes)
    assert not {*gone.split()} & tree(root).keys()
    assert manifest_is_true(root)
    set_up(root, broker="here", page=True)
    assert {*gone.split()} <= tree(root).keys()


def test_commands_run_again_only_for_what_changed_and_are_undone(root: Path) -> None:
    ran: list[str] = []
    places = Places(root)
    file = root / "etc/a"

    def steps(content: bytes) -> list[Step]:
        restart = ("systemctl", "restart", "a")
        return [
            Step(what="file", target=file, content=content),
            Step(what="restart", command=restart, of=(file,), undo=("stop", "a"), after=restart, live=True),
            Step(what="not here", command=("b",), cannot="there is no b", live=True),
        ]

    def engine(known: Manifest | None) -> Engine:
        return Engine(places, known or Manifest(), run=lambda command: ran.append(" ".join(command)), is_live=True)

    for content in (b"1", b"1", b"2"):
        found = [result.state for result in engine(manifest.load(places)).apply(steps(content))]
        assert found[2] is State.CANNOT
    assert ran == ["systemctl restart a"] * 2
    list(engine(manifest.load(places)).undo(steps(b"2"), purge=False))
    assert ran[2:] == ["stop a", "systemctl restart a"]
    assert not file.exists()


def test_no_password_is_shown_or_stored_but_where_it_belongs(root: Path, answers: Path, run: Run) -> None:
    assert run("setup", "--root", root, "--answers", answers, "--yes") == 0
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
