"""Settings: what is published of them, which values they accept, and the command line that follows."""

from __future__ import annotations

import argparse
import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pebble.extensions.operator.client.forms import MAX_TEXT, Setting, SettingError, arguments, effective, form

SPEED = Setting(key="speed", type="float", default=0.5, arg="--speed", min=0.05, max=1)
LAPS = Setting(key="laps", type="int", default=3, arg="--laps", min=0)
NAME = Setting(key="name", type="string", default="", arg="--name")
MODE = Setting(key="mode", type="enum", default="slow", arg="--mode", options=("slow", "fast"))
LIGHT = Setting(key="light", type="bool", default=False, arg="--light", arg_false="--no-light", mode="flag")
SIZE = Setting(key="size", type="float", arg="--size", required=True)
ALL = (SPEED, LAPS, NAME, MODE, LIGHT)

#: Anything that JSON can hold, and what Python's decoder makes of NaN.
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=5,
)


def test_an_entry_has_the_keys_of_the_contract_and_no_others() -> None:
    assert form((SPEED, LIGHT, MODE, SIZE, Setting(key="bare", min=1, options=("x",)))) == [
        {"key": "speed", "label": "speed", "type": "float", "default": 0.5, "arg": "--speed", "min": 0.05, "max": 1},
        {"key": "light", "label": "light", "type": "bool", "default": False, "arg": "--light", "mode": "flag",
         "arg_false": "--no-light"},
        {"key": "mode", "label": "mode", "type": "enum", "default": "slow", "arg": "--mode",
         "options": ["slow", "fast"]},
        {"key": "size", "label": "size", "type": "float", "default": None, "arg": "--size", "required": True},
        {"key": "bare", "label": "bare", "type": "string", "default": None, "arg": ""},
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("setting", "raw", "value"),
    [
        (SPEED, "0.25", 0.25), (SPEED, 1, 1.0), (SPEED, 0.05, 0.05),
        (LAPS, "7", 7), (LAPS, 7.0, 7),
        (LIGHT, "on", True), (LIGHT, " Disabled ", False), (LIGHT, 1, True), (LIGHT, True, True),
        (MODE, "fast", "fast"), (NAME, 5, "5"), (SPEED, None, 0.5),
    ],
)  # fmt: skip
def test_values_are_accepted_also_as_text(setting: Setting, raw: Any, value: Any) -> None:
    values = effective((setting,), {setting.key: raw, "unknown": 1})
    assert values == {setting.key: value}
    assert type(values[setting.key]) is type(value)


@pytest.mark.parametrize(
    ("setting", "raw", "error"),
    [
        (SPEED, 0.01, "speed below minimum 0.05"),
        (SPEED, "1.5", "speed above maximum 1"),
        (LAPS, -1, "laps below minimum 0"),
        (SPEED, math.nan, "speed must be a finite number"),
        (SPEED, "1e999", "speed must be a finite number"),
        (SPEED, 10**400, "speed must be a finite number"),
        (LAPS, 1e300, "laps must be a whole number"),
        (SPEED, True, "speed must be a number"),
        (LAPS, 1.5, "laps must be a whole number"),
        (LIGHT, "maybe", "light must be true or false"),
        (MODE, "a\x1b[2J", "Invalid option 'a?[2J' for mode"),
        (NAME, "--log-file=/etc/passwd", "name must not begin with '-'"),
        (NAME, "x" * (MAX_TEXT + 1), f"name is longer than {MAX_TEXT} characters"),
        (NAME, "a\0b", "name must not contain control characters"),
        (NAME, True, "name must be text"),
        (SIZE, None, "Missing required config field 'size'"),
    ],
)  # fmt: skip
def test_other_values_are_refused_with_the_reason(setting: Setting, raw: Any, error: str) -> None:
    with pytest.raises(SettingError) as caught:
        effective((setting,), {} if raw is None else {setting.key: raw})
    assert str(caught.value) == error


def test_an_option_and_its_value_are_two_words_and_flags_one() -> None:
    values = effective((*ALL, Setting(key="exact", type="bool", default=True, arg="--exact", mode="value")), {})
    words = arguments((*ALL, Setting(key="exact", type="bool", arg="--exact", mode="value")), values)
    assert words == [
        "--speed", "0.5", "--laps", "3", "--name", "", "--mode", "slow", "--no-light", "--exact", "true",
    ]  # fmt: skip


def test_small_numbers_are_no_options_to_argparse() -> None:
    tiny = Setting(key="tiny", type="float", arg="--tiny")
    assert arguments((tiny,), {"tiny": -1e-05}) == ["--tiny", "-0.00001"]


def accepted(wanted: dict[str, Any]) -> dict[str, Any]:
    try:
        return dict(effective(ALL, wanted))
    except SettingError as error:
        assert str(error).isprintable()  # noqa: PT017 - any of them
        return dict(effective(ALL, {}))


@given(st.dictionaries(st.sampled_from([setting.key for setting in ALL]), json_values))
def test_whatever_is_sent_the_script_reads_exactly_the_effective_settings(wanted: dict[str, Any]) -> None:
    values = accepted(wanted)
    parser = argparse.ArgumentParser()
    parser.add_argument("--speed", type=float)
    parser.add_argument("--laps", type=int)
    parser.add_argument("--name")
    parser.add_argument("--mode", choices=MODE.options)
    parser.add_argument("--light", action=argparse.BooleanOptionalAction)
    assert vars(parser.parse_args(arguments(ALL, values))) == values
    json.dumps(values, allow_nan=False)
    assert 0.05 <= values["speed"] <= 1


def test_a_command_cannot_name_a_file_on_the_robot() -> None:
    for key in ("log_file", "output_path", "save-dir", "LOG_FILE"):
        setting = Setting(key=key, default="/var/log/x", arg="--x")
        assert form((setting,)) == []
        assert effective((setting,), {key: "/etc/passwd"}) == {key: "/var/log/x"}
    assert Setting(key="record", arg="--record-file").names_file, "by its name on the command line"
    assert not Setting(key="profile", arg="--profile").names_file
