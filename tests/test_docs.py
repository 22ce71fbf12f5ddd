"""The hand-written documents point to things that are there."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import typer

from pebble.commands.app import application
from pebble.extensions.checks.conform.checks import CHECKS, LAST
from pebble.extensions.checks.conform.control import CONTROL, named
from pebble.extensions.checks.conform.motion import MOVING
from pebble.extensions.checks.keys import keys_text
from tests.support import ROOT
from tools.bounds import bounds

DOCUMENTS = [
    *sorted(ROOT.glob("*.md")),
    *sorted((ROOT / ".github").rglob("*.md")),
    ROOT / "firmware" / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
LINK = re.compile(r"\]\((?!https?:)([^)#]+)")
#: `folder/`, `folder/file.py` or `file.py`; what begins like a topic below a robot's identity is none, and what is
#: below build/ is written by a run
CODE = re.compile(
    r"`((?!(?:incoming|outgoing|flags|sensors|mcu|by|build|pebble/robots|system)/)(?:[\w.-]+/)+[\w.-]*|[\w-]+\.(?:py|md|toml|json))`"
)
OURS = ("pebble", "transports", "services", "firmware")


ANCHOR = re.compile(r"\]\((?!https?:)([^)#]*)#([^)]+)\)")
DECISIONS = sorted((ROOT / "docs" / "decisions").glob("*.md"))


def anchors(path: Path) -> set[str]:
    headings = re.findall(r"^#+ (.+)$", path.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_anchors_and_files_that_it_names_exist(document: Path) -> None:
    text, folder = document.read_text(), document.parent
    assert [link for link in LINK.findall(text) if not (folder / link).exists()] == []
    assert [link for link in ANCHOR.findall(text) if link[1] not in anchors(folder / (link[0] or document.name))] == []
    assert [name for name in CODE.findall(text) if not _exists(name)] == []


ALL_TEXT = "\n".join(path.read_text() for path in DOCUMENTS)
EXAMPLES = {"MyTransport", "twist_mux"}  # a class of the reader; a program of ROS 1


def test_classes_functions_and_variables_that_they_name_exist() -> None:
    kinds = {".py", ".js", ".mjs", ".json", ".cpp", ".h", ".service"}
    files = (path for folder in (*OURS, "configs", "examples", "tests") for path in (ROOT / folder).rglob("*"))
    known = {word for path in files if path.suffix in kinds for word in re.findall(r"\w+", path.read_text())}
    names = re.findall(r"`((?:[A-Z][a-z]+){2,}|_?[a-z]+(?:_[a-z0-9]+)+)(?:\(\))?`", ALL_TEXT)
    assert {*names} - known - EXAMPLES == set()


def test_pages_that_code_names_exist() -> None:
    files = (path for folder in (*OURS, "configs", "examples") for path in (ROOT / folder).rglob("*.*"))
    texts = [path.read_text() for path in files if path.suffix in {".py", ".js", ".json", ".service", ".cpp"}]
    assert {page for page in re.findall(r"docs/[\w/-]+\.md", "".join(texts)) if not (ROOT / page).exists()} == set()


def test_keys_of_a_config_that_they_name_exist() -> None:
    keys = re.findall(r"`((?:services|security|local_mqtt|web_interface)(?:\.[a-z_]+)+)`", ALL_TEXT)
    original = {"web_interface.mqtt_history"}
    assert {key for key in keys if f"`{key}`" not in keys_text()} - original == set()


def test_no_page_is_longer_than_one_reads() -> None:
    assert {path.name: words for path in DOCUMENTS if (words := len(path.read_text().split())) > 1600} == {}


def test_every_page_can_be_found_from_the_index() -> None:
    index = (ROOT / "docs" / "README.md").read_text()
    linked = {(ROOT / "docs" / link).resolve() for link in LINK.findall(index)}
    pages = {path for path in DOCUMENTS if path.is_relative_to(ROOT / "docs") and path not in DECISIONS}
    assert pages - linked - {ROOT / "docs" / "README.md"} == set()


def test_the_first_extension_and_its_test_run_as_they_stand(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "my-first-extension.md").read_text()
    service, test, package = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    (config,) = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    (metadata,) = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    for name, content in {"battery_alarm": service, "test_battery_alarm": test, "pebble_alarm": package}.items():
        (tmp_path / f"{name}.py").write_text(content)
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"}

    def run(*command: str) -> str:
        line = [sys.executable, "-m", *command]
        return subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False).stdout

    assert "1 passed" in run("pytest", "--quiet", "test_battery_alarm.py")
    (tmp_path / "robot.json").write_text(config)
    assert "zenoh_hub, battery_alarm" in run("pebble.cli", "check", "robot.json")
    points = tomllib.loads(metadata)["project"]["entry-points"]["pebble.extensions"]
    (tmp_path / "pebble_alarm-1.dist-info").mkdir()
    lines = [f"{name} = {place}" for name, place in points.items()]
    (tmp_path / "pebble_alarm-1.dist-info" / "entry_points.txt").write_text("\n".join(["[pebble.extensions]", *lines]))
    named = {"extensions": {"alarm": {}}, "services": {"alarm": {"enabled": True, "volts": 5}}}
    (tmp_path / "robot.json").write_text(json.dumps(json.loads(config) | named))
    assert "below 5 V" in run("pebble.cli", "check", "robot.json")
    assert "its battery is empty before it warns" in run("pebble.cli", "doctor", "robot.json")
    assert run("pebble.cli", "alarm") == "warns of a low battery\n"


#: A command line in a block of code.
COMMAND = re.compile(r"^(?: {4}|\$ )(?:\.venv/bin/)?pebble (.+)$", re.MULTILINE)
WRITTEN = sorted({line for path in DOCUMENTS for line in COMMAND.findall(path.read_text())})


@pytest.fixture(scope="module")
def pebble() -> Any:
    return application()


@pytest.mark.parametrize("line", WRITTEN)
def test_a_command_line_is_one_that_exists(pebble: Any, line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is parsed with all its options, and not run; files that it names need not be there."""
    monkeypatch.setattr(pebble.context_class, "invoke", lambda *_, **__: None)
    try:
        pebble.main(shlex.split(line, comments=True), "pebble", standalone_mode=False)
    except typer.BadParameter as error:
        assert "does not exist" in error.message  # noqa: PT017


def test_extras_targets_and_modules_are_ones_that_exist() -> None:
    extras = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"])
    rules = re.findall(r"^([a-z][a-z -]*):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    targets = {target for rule in rules for target in rule.split()}
    example = "pebble.services.lamp"
    modules = set(re.findall(r"python -m ((?:pebble|tests)\.[\w.-]*\w)", ALL_TEXT)) - {example}
    named = {name for names in re.findall(r"'\.\[([\w,]+)\]'", ALL_TEXT) for name in names.split(",")}
    assert named - extras == set()
    assert set(re.findall(r"(?:^ {4}|`)make ([a-z][\w-]+)", ALL_TEXT, re.MULTILINE)) - targets == set()
    parts = set(re.findall(r"^make long PART=(\w+)", (ROOT / "tools" / "long.sh").read_text(), re.MULTILINE))
    assert set(re.findall(r"make long PART=(\w+)", ALL_TEXT)) - parts == set()
    assert [module for module in sorted(modules) if find_spec(module) is None] == []


def test_each_bound_has_a_comment_that_says_what_it_bounds() -> None:
    assert [f"{bound.file}: {bound.name}" for bound in bounds() if not bound.why] == []


def test_each_check_is_beside_its_duty_and_counted() -> None:
    text = (ROOT / "docs" / "your-robot.md").read_text()
    described = {name for row in re.findall(r"^\|.*\| (.*) \|$", text, re.MULTILINE) for name in row.split(", ")}
    made = {check.name for checks in (CHECKS, CONTROL, MOVING, LAST) for check in checks}
    assert made - described == set()
    at_rest, moving = (
        len([check for check in checks if check.binds is not named]) for checks in ((*CHECKS, *CONTROL, *LAST), MOVING)
    )
    assert f"NOT JUDGED: {moving} with --may-move" in text
    assert f"checks: {at_rest}, warnings: 0, failures: 0" in text


def _exists(name: str) -> bool:
    """A path from the top, or the name of a file somewhere in the sources."""
    return (ROOT / name).exists() or any(any((ROOT / folder).rglob(name)) for folder in OURS)
