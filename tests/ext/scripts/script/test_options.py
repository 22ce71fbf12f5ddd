"""A Struct becomes a form and an argument parser; what cannot is refused by name."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest
from msgspec import Meta, Struct

from pebble.extensions.scripts.script import Robot, run
from pebble.extensions.scripts.script.options import OneLineParser, form, parse


class Options(Struct, kw_only=True):
    """Every kind of option; form.json holds its form."""

    tag_size_m: Annotated[float, Meta(ge=0.01, title="Tag Size (m)")]
    tag_id: Annotated[int, Meta(ge=0, le=34, title="Tag ID")] = 13
    power: Annotated[float, Meta(ge=-1, le=1, title="Power", extra={"step": 0.05})] = 1
    speed: Literal["slow", "fast", "automatic"] = "slow"
    family: Annotated[Literal["36h11", "25h9"], Meta(title="Tag family")] = "25h9"
    search: bool = True
    quiet: Annotated[bool, Meta(title="No sound")] = False
    note: str = ""
    limit: Annotated[int, Meta(ge=1)] | None = None
    width_mm: Annotated[float | None, Meta(title="Width (mm)")] = None


def parsed(*arguments: str) -> Options:
    return parse(Options, ["--tag-size-m", "0.25", *arguments], OneLineParser(prog="run.py"))[0]


def walk(robot: Robot, options: Options) -> None:
    raise SystemExit(9)


def test_a_script_describes_itself_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["/scripts/follow/run.py", "--describe"])
    run(walk, summary="Walks.", main_options=["power"], needs={"wheel-odometry": {"magnets": 10}})
    described = capsys.readouterr().out
    assert described.count("\n") == 1
    assert json.loads(described) == {
        "label": "follow",
        "summary": "Walks.",
        "main": ["power"],
        "configs": json.loads(Path(__file__).with_name("form.json").read_bytes()),
        "dependencies": [{"file": "wheel-odometry", "config": {"magnets": 10}}],
    }
    monkeypatch.setattr(sys, "argv", ["run.py", "--describe", "--tag-size-m", "1"])
    with pytest.raises(SystemExit, match="2"):
        run(walk)
    assert "--describe goes alone" in capsys.readouterr().err
    monkeypatch.setattr(sys, "argv", ["run.py", "--describe"])
    for main_options, problem in ((["speedd"], "there is no option speedd"), (["power"] * 4, "4 are more than 3")):
        with pytest.raises(TypeError, match=f"main_options: {problem}"):
            run(walk, main_options=main_options)


@pytest.mark.parametrize(
    ("arguments", "key", "value"),
    [
        ("--tag-id 7", "tag_id", 7), ("--power -1e-05", "power", -1e-05), ("--power=-0.5", "power", -0.5),
        ("--speed fast", "speed", "fast"), ("--no-search", "search", False), ("--quiet", "quiet", True),
        ("--note -x", "note", "-x"), ("--limit 3", "limit", 3), ("--width-mm 120", "width_mm", 120.0),
        ("", "power", 1), ("", "limit", None),
    ],
)  # fmt: skip
def test_a_command_line(arguments: str, key: str, value: object) -> None:
    found = getattr(parsed(*arguments.split()), key)
    assert (found, type(found)) == (value, type(value))


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["--tag-id", "x"], "--tag-id: tag_id must be a whole number"),
        (["--tag", "3"], "unrecognized arguments: --tag 3"),
        (None, "run.py: the following arguments are required: --tag-size-m (see --help)\n"),
    ],
)
def test_a_wrong_command_line_is_one_line(
    arguments: list[str] | None, problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_:
        parse(Options, [], OneLineParser(prog="run.py")) if arguments is None else parsed(*arguments)
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert problem in error


@pytest.mark.parametrize(
    ("kind", "default", "problem"),
    [
        (list[int], (), "option x: list cannot become a form: use bool, int, float, str or Literal of strings"),
        (int | str, 1, "option x: a form has no place for a choice of types"),
        (Literal[1, 2], 1, "option x: a Literal must list strings only"),
        (Annotated[float, Meta(gt=0)], 1.0, "option x: the bounds of a form belong to it: write ge instead of gt"),
        (bool | None, None, "option x: a bool is true or false"),
        (int, 1.5, "option x: its default 1.5 is refused: x must be a whole number"),
    ],
)
def test_what_cannot_become_a_form_is_named(kind: Any, default: object, problem: str) -> None:
    with pytest.raises(TypeError) as error:
        form(msgspec.defstruct("Wrong", [("x", kind, default)]))
    assert str(error.value).startswith(problem)


@pytest.mark.parametrize("names", [("config",), ("help",), ("a", "no_a")])
def test_options_that_every_script_has_are_reserved(names: tuple[str, ...]) -> None:
    with pytest.raises(TypeError, match="rename the field"):
        form(msgspec.defstruct("Wrong", [(name, bool, False) for name in names]))


class Renamed(Struct):
    """An option of another name than its key, which a form marks as required although it has a default."""

    tag_size_m: Annotated[float, Meta(ge=0.01, extra={"arg": "marker-size", "required": True})] = 0.25
    use_state: Annotated[bool, Meta(extra={"arg": "tuned"})] = False


def test_an_option_may_have_another_name_than_its_key() -> None:
    size, state = form(Renamed)
    assert (size.key, size.arg, size.required, size.default) == ("tag_size_m", "--marker-size", True, 0.25)
    assert (state.arg, state.arg_false) == ("--tuned", "--no-tuned")
    given = parse(Renamed, ["--marker-size", "0.5", "--tuned"], OneLineParser(prog="run.py"))[0]
    assert (given.tag_size_m, given.use_state) == (0.5, True)
    assert parse(Renamed, [], OneLineParser(prog="run.py"))[0].tag_size_m == 0.25
