"""Answers come from a file, from options, from the last time, or are asked; what is missing is named by its key."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from pebble.setup.places import Places
from tests.commands.command_line import Run
from tests.kit.terminal import Terminal
from tests.setup.rig import ANSWERS, PASSWORD, tree
from tests.support import ROOT

FAR = ANSWERS | {"broker": "broker.lab:8884", "broker_user": "goob"}


def without(key: str, **more: Any) -> dict[str, Any]:
    return {name: value for name, value in (ANSWERS | more).items() if name != key}


@pytest.mark.parametrize(
    ("given", "keys"),
    [
        (without("id"), ["id"]),
        (without("port"), ["port"]),
        (without("protocol"), ["protocol"]),
        (without("camera"), ["camera"]),
        (without("broker"), ["broker"]),
        (without("page"), ["page"]),
        (without("user"), ["user"]),
        (ANSWERS | {"broker": "broker.lab"}, ["broker_user", "broker_password_file"]),
        (FAR, ["broker_password_file"]),
        ({}, ["id", "port", "camera", "broker", "page"]),
    ],
    ids=lambda value: ",".join(value),
)
def test_a_missing_answer_is_named_by_its_key(
    given: dict[str, Any], keys: list[str], root: Path, answers: Path, run: Run
) -> None:
    password = json.loads(answers.read_text())["password_file"]
    answers.write_text(json.dumps(given | {"password_file": password}))
    before = tree(root)
    assert run("setup", "--root", root, "--answers", answers, "--yes") == 2
    assert [line.split()[1:4] for line in run.err.splitlines()] == [[key, "is", "missing:"] for key in keys]
    assert tree(root) == before


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"id": "go/ob"}, "id: must be a topic level"),
        ({"id": "page"}, "id: 'page' is an account of the robot's own broker already"),
        ({"protocol": "morse"}, "protocol: 'morse' is none of goob_base_v1"),
        ({"broker": "mqtt://broker.lab"}, "broker: write HOST or HOST:PORT"),
        ({"broker": "ann:secret-1@broker.lab"}, "broker: write HOST or HOST:PORT; user and password have keys"),
        ({"broker": "none"}, "page: a page needs a broker"),
        ({"user": "Ann Lee"}, "user: 'Ann Lee' is no name"),
        ({"page": "yes"}, "answers: Expected `bool"),
        ({"colour": "red"}, "colour: unknown key; there are id, port"),
        ({"password_file": "/nowhere"}, "--password-file: No such file or directory"),
    ],
    ids=lambda value: str(value)[:24],
)
def test_a_wrong_answer_is_one_line_and_nothing_is_written(
    given: dict[str, Any], message: str, root: Path, answers: Path, run: Run
) -> None:
    answers.write_text(json.dumps(json.loads(answers.read_text()) | given))
    before = tree(root)
    assert run("setup", "--root", root, "--answers", answers, "--yes") in (1, 2)
    assert message in run.err
    assert run.err.count("\n") == 1
    assert "secret-1" not in run.err
    assert tree(root) == before


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (("--purge",), "--purge needs --undo"),
        (("--as", "fred"), "--as needs --from FILE"),
        (("--id", "goob"), "port is missing"),
        (("--undo", "--yes"), "this machine was not set up by this command"),
        (("--from", "/nowhere", "--yes"), "/nowhere: No such file or directory"),
    ],
)
def test_options_that_do_not_fit(line: tuple[str, ...], message: str, root: Path, run: Run) -> None:
    assert run("setup", "--root", root, *line) in (1, 2)
    assert message in run.err
    assert not Places(root).etc.exists()


def test_without_a_terminal_it_is_confirmed_by_an_option(root: Path, answers: Path, run: Run) -> None:
    assert run("setup", "--root", root, "--answers", answers) == 2
    assert "yes is missing" in run.err
    assert not Places(root).etc.exists()


def test_six_questions_in_a_terminal(root: Path) -> None:
    """Wrong names are asked again, choices are numbers or texts, and no password shows."""
    typed = [
        ("Name [", "no/name"),
        ("Name [", "goob"),
        ("answer [", "none"),
        ("answer [", "synthetic"),
        ("answer [", "1"),
        ("Page [", "y"),
        ("everything [", "ann"),
        ("ann: ", PASSWORD),
        ("Again: ", PASSWORD),
        ("it? [", "y"),
    ]
    program = ["env", "-C", str(ROOT), "-u", "SUDO_USER", sys.executable, "-m", "pebble.cli"]
    terminal = Terminal([*program, "setup", "--root", str(root)])
    for prompt, text in typed:
        terminal.answers(prompt, text)
    assert terminal.ends() == 0, terminal.shown
    assert "id: must be a topic level" in terminal.shown
    assert PASSWORD not in terminal.shown
    assert "Open https://" in terminal.shown
    assert json.loads(Places(root).config.read_text())["robot"]["id"] == "goob"
