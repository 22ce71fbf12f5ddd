"""Whether a start is possible, and the words for why it is not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from msgspec import structs

from pebble.extensions.operator.client.forms import Setting
from pebble.services.autonomy_manager.script import Dependency, Script, StartError, plan


def script(file: str, *dependencies: Dependency) -> Script:
    settings = (Setting(key="speed", type="float", default=0.5, arg="--speed", max=1),)
    return Script(
        file=file, label=file, command=("x",), folder=Path(), settings=settings, dependencies=dependencies
    )  # fmt: skip


SCRIPTS = {
    "walk": script("walk", Dependency("eyes", {"speed": 1})),
    "eyes": script("eyes"),
    "new": structs.replace(script("new"), asked=False),
    "lost": script("lost", Dependency("nose")),
    "late": script("late", Dependency("new")),
    "torn": structs.replace(script("torn"), broken="run.py, line 3: invalid syntax"),
    "needy": script("needy", Dependency("torn")),
    "fast": script("fast", Dependency("eyes", {"speed": 9})),
}


def test_a_plan_has_the_dependencies_with_their_own_settings() -> None:
    found = plan(SCRIPTS, "walk", {"speed": "0.1"})
    assert [(step.script.file, step.options) for step in (*found.dependencies, found.main)] == [
        ("eyes", ("--speed", "1.0")),
        ("walk", ("--speed", "0.1")),
    ]
    assert found.config == {"speed": 0.1}


@pytest.mark.parametrize(("there", "typed"), [("ba\u0308r", "b\u00e4r"), ("b\u00e4r", "ba\u0308r"), ("bar", "bar")])
def test_a_script_is_started_by_a_name_that_looks_the_same(there: str, typed: str) -> None:
    found = plan({"x": script("x", Dependency(typed)), there: script(there)}, "x", {})
    assert [step.script.file for step in found.dependencies] == [there]
    assert plan({there: script(there)}, typed, {}).main.script.file == there


@pytest.mark.parametrize(
    ("file", "config", "error"),
    [
        ("run\x1b", {}, "Unknown autonomy file: run?"),
        ("walk", {"speed": 2}, "Invalid config for walk: speed above maximum 1"),
        ("lost", {}, "Failed to start lost: Dependency script not found: nose"),
        ("torn", {"speed": 2}, "Failed to start torn: run.py, line 3: invalid syntax"),
        ("needy", {}, "Failed to start needy: torn: run.py, line 3: invalid syntax"),
        ("new", {}, "Failed to start new: it is still asked what it needs"),
        ("late", {}, "Failed to start late: new: it is still asked what it needs"),
        ("fast", {}, "Failed to start fast: Invalid config for eyes: speed above maximum 1"),
    ],
)
def test_a_start_that_is_not_possible_is_refused_with_the_originals_words(
    file: str, config: dict[str, Any], error: str
) -> None:
    with pytest.raises(StartError) as caught:
        plan(SCRIPTS, file, config)
    assert str(caught.value) == error
