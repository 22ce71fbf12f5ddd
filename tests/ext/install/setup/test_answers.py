"""Answers come from a file, from the config, or are asked; what is missing or wrong is named by its key."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.operator.places import Places
from tests.commands.command_line import Run
from tests.ext.install.setup.rig import ANSWERS, PASSWORD, answers_in, set_up, tree
from tests.kit.terminal import Terminal


def without(key: str) -> dict[str, Any]:
    return {name: value for name, value in ANSWERS.items() if name != key}


@pytest.mark.parametrize(
    ("given", "keys"),
    [
        *((without(key), [key]) for key in ("protocol", "user")),
        (ANSWERS | {"broker": "broker.lab"}, ["broker_user", "broker_password_file"]),
        ({}, ["id", "port", "camera", "broker", "page"]),
    ],
    ids=lambda value: ",".join(value),
)
def test_a_missing_answer_is_named_by_its_key(
    given: dict[str, Any], keys: list[str], root: Path, tmp_path: Path, run: Run
) -> None:
    answers = answers_in(tmp_path)
    password = json.loads(answers.read_text())["password_file"]
    answers.write_text(json.dumps(given | {"password_file": password}))
    before = tree(root)
    assert run("setup", "--answers", answers) == 2
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
        ({"broker_ca": "/etc/passwd", "broker": "127.0.0.1"}, "broker_ca: /etc/passwd holds no certificate"),
        ({"user": "Ann Lee"}, "user: 'Ann Lee' is no name"),
        ({"colour": "red"}, "colour: unknown key; there are id, port"),
        ({"password_file": "/nowhere"}, "password_file: No such file or directory"),
    ],
    ids=lambda value: str(value)[:24],
)
def test_a_wrong_answer_is_one_line_and_nothing_is_written(
    given: dict[str, Any], message: str, root: Path, tmp_path: Path, run: Run
) -> None:
    before = tree(root)
    assert run("setup", "--answers", answers_in(tmp_path, **given)) in (1, 2)
    assert message in run.err
    assert run.err.count("\n") == 1
    assert "secret-1" not in run.err
    assert tree(root) == before


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ((), "standard input is no terminal, so nothing can be asked: --answers FILE"),
        (("--from", "/nowhere"), "/nowhere: No such file or directory"),
    ],
)
def test_options_that_lead_nowhere(line: tuple[str, ...], message: str, root: Path, run: Run) -> None:
    assert run("setup", *line) in (1, 2)
    assert message in run.err
    assert not any(Places(root).etc.iterdir())


def test_a_robot_keeps_its_name_where_the_answers_are_of_another_one(root: Path, tmp_path: Path, run: Run) -> None:
    set_up(root)
    before = tree(root)
    assert run("setup", "--answers", answers_in(tmp_path, id="fred")) == 2
    assert "id: this robot is goob" in run.err
    assert tree(root) == before


def test_without_mosquitto_there_is_no_broker_here(root: Path, tmp_path: Path, run: Run) -> None:
    (root / "usr/sbin/mosquitto").unlink()
    assert run("setup", "--answers", answers_in(tmp_path)) == 2
    assert run.err == "pebble: broker: mosquitto is not installed: sudo apt install mosquitto, then sudo pebble setup\n"
    assert not any(Places(root).etc.iterdir())


def terminal(root: Path) -> Terminal:
    """The command in a terminal of 60 columns."""
    script = (
        "from pathlib import Path; from pebble.extensions.install.setup.session import set_up;"
        "from tests.ext.install.setup.rig import machine;"
        f"exit(set_up(machine(Path({str(root)!r})), None, None))"
    )
    return Terminal("env", "-u", "SUDO_USER", "COLUMNS=60", sys.executable, "-c", script)


def test_six_questions_in_a_terminal(root: Path) -> None:
    """Wrong names are asked again, choices are numbers or texts, lines end between words, no password shows."""
    asking = terminal(root)
    for prompt, text in (
        ("Name [", "no/name"),
        ("Name [", "goob"),
        ("answer [", "none"),
        ("answer [", "synthetic"),
        ("[:PORT] [here]", "1"),
        ("Page [Y/n]", ""),
        ("everything [", "ann"),
        ("ann: ", PASSWORD),
        ("Again: ", PASSWORD),
        ("Go ahead? [Y/n]", ""),
    ):
        asking.answers(prompt, text)
    assert asking.ends() == 1, "systemd does not run there"
    shown = asking.shown.replace("\r", "")
    assert "id: must be a topic level" in shown
    assert PASSWORD not in shown
    assert [line for line in shown.splitlines() if len(line) > 60 and " " in line.strip()] == []
    assert len(re.findall(r"Open\s+https://", shown)) == 1
    assert json.loads(Places(root).config.read_text())["robot"]["id"] == "goob"


def test_a_login_that_the_broker_refused_is_asked_again(root: Path, tmp_path: Path) -> None:
    set_up(root, broker="127.0.0.1:9", broker_user="goob", port="none")
    asking = terminal(root)
    for prompt in ("answer [none]", "answer [synthetic]", "[:PORT] [127.0.0.1:9]", "Page [Y/n]"):
        asking.answers(prompt, "")
    asking.answers("goob at the broker (empty: as before): ", "another")
    asking.answers("Go ahead?", "")
    asking.ends()
    assert "the broker 127.0.0.1:9 does not" in " ".join(asking.shown.split())
    assert (Places(root).etc / "broker.password").read_text() == "another\n"
