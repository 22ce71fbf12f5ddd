"""How robots look to people: names, colours, drawings and the charge of a battery."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any, get_args

from pebble.contract.looks import Body, Colour
from tests.ext.page.in_node import Rows, Script, evaluate, rows
from tests.support import ROOT

LOOKS = "ui/parts/looks.js"
looks = Script(
    {LOOKS: "charge, looksOf"},
    "const look = (id, payload) => looksOf(`pebble/robots/${id}`, payload);"
    "const brief = (one) => [one.name, one.picture, typeof one.colour, one.cells];"
    "const percent = (value, unit, cells) => charge({ value, unit }, cells);",
)


def stated(**identity: Any) -> str:
    return json.dumps({"value": {"identity": identity, "drive": {"available": True}}})


# fmt: off
WHOLE = {"name": "Otto", "description": "A boat", "colour": "rose", "picture": "boat"}
FACES: Rows = {
    "it looks as it says": (
        f"result = look('otto', {stated(**WHOLE, battery_cells=2)});", {**WHOLE, "cells": 2}),
    "a name that is not its id has it behind": (
        f"result = ['mini-lamp', 'fred'].map((id) => look(id, {stated(name='Mini Lamp')}).name);",
        ["Mini Lamp", "Mini Lamp (fred)"]),
    "the original's robots are known": (
        "result = ['goob', 'bumperbot'].map((id) => look(id)).map((one) => [one.colour, one.picture]);",
        [["blue", "goob"], ["green", "benjr"]]),
    "what drives has wheels": (f"result = look('r7', {stated()}).picture;", "wheeled"),
    "an outlet is one": ("result = look('r7', { value: { outlets: { available: true } } }).picture;", "outlets"),
    "another is unknown, and has a colour": ("result = brief(look('r7', null));", ["r7", "unknown", "string", 0]),
    "what is no look is not used": (
        f"result = brief(look('constructor', {stated(colour='url(x)', picture='__proto__', battery_cells=-1)}));",
        ["constructor", "wheeled", "string", 0]),
    "a long name is cut": (f"result = look('r7', {stated(name='x' * 40)}).name;", "x" * 32 + " (r7)"),
    "a name steers nothing": (f"result = look('r7', {stated(name=chr(0x202E) + 'x')}).name;", "\\u202ex (r7)"),
    "a battery is in percent where its cells are known": (
        "result = [[8.4, 2], [6, 2], [7.64, 2], [9, 2], [8, 0]].map(([value, cells]) => percent(value, 'V', cells));",
        [100, 0, 50, 100, None]),
    "or where it says percent": (
        "result = [percent(81, '%', 0), percent('x', 'V', 2), charge(undefined, 2)];", [81, None, None]),
}
# fmt: on


@rows((looks, FACES))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected


def test_a_config_may_name_what_the_page_can_draw() -> None:
    drawn, tints = evaluate({LOOKS: "PICTURES, TINTS"}, "result = [Object.keys(PICTURES), TINTS];")
    sprite = (ROOT / "pebble/extensions/page/static/faces.svg").read_text()
    symbols = dict(re.findall(r'<symbol id="face-(\w+)"(.*?)</symbol>', sprite))
    assert drawn == list(get_args(Body)) == list(symbols)
    assert tints == list(get_args(Colour))
    assert max(map(len, symbols.values())) < 1500
    assert not re.search(r"script|style|href|url\(", sprite)
