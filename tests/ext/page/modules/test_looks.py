"""How robots look to people, where their cards are, their log lines, and notices; in Node.js and virtual time."""

from __future__ import annotations

import json
import re
import sys
import unicodedata
from collections.abc import Callable
from typing import Any, get_args

import pytest

from pebble.config.visible import shown
from pebble.contract.looks import Body, Colour
from tests.ext.page.in_node import Rows, Script, evaluate, rows
from tests.support import ROOT, some

LOOKS = "ui/parts/looks.js"
looks = Script(
    {
        LOOKS: "charge, hasFace, looksOf",
        "ui/parts/more-words.js": "charging, plain",
        "ui/parts/words.js": "battery, reported, span",
    },
    "const look = (id, payload) => looksOf(`pebble/robots/${id}`, payload);"
    "const brief = (one) => [one.name, one.picture, typeof one.colour, one.cells];"
    "const percent = (value, unit, cells) => charge({ value, unit }, cells);",
)


def stated(**identity: Any) -> str:
    return json.dumps({"value": {"identity": identity, "drive": {"available": True}}})


# fmt: off
WHOLE = {"name": "Otto", "description": "A boat", "colour": "rose", "picture": "boat"}
FACES: Rows = {
    "what is long is cut": (
        f"const one = look('r7', {stated(name='x' * 40, description='y' * 99)}); result = [one.name, one.description];",
        ["x" * 32 + " (r7)", "y" * 60]),
    "it looks as it says": (
        f"result = look('otto', {stated(**WHOLE, battery_cells=2)});", {**WHOLE, "cells": 2}),
    "a name that is not its id has it behind": (
        f"result = ['mini-lamp', 'fred'].map((id) => look(id, {stated(name='Mini Lamp')}).name);",
        ["Mini Lamp", "Mini Lamp (fred)"]),
    "another is unknown, and has a colour": ("result = brief(look('r7', null));", ["r7", "unknown", "string", 0]),
    "what is no look is not used": (
        f"result = brief(look('constructor', {stated(colour='url(x)', picture='__proto__', battery_cells=-1)}));",
        ["constructor", "wheeled", "string", 0]),
    "a name steers nothing": (f"result = look('r7', {stated(name=chr(0x202E) + 'x')}).name;", "\\u202ex (r7)"),
    "a battery is in percent where its cells are known": (
        "result = [[8.4, 2], [6, 2], [7.64, 2], [9, 2], [8, 0]].map(([value, cells]) => percent(value, 'V', cells));",
        [100, 0, 50, 100, None]),
    "any value of it is one line": ("""
        result = [1234.5678, 123_456.7, null, undefined, true, [1, { a: 2 }], { a: { b: "x" }, c: [] }].map(plain);""",
        ["1234.6", "123457", "–", "–", "true", "[1, a 2]", "a {b x} · c []"]),
}
# fmt: on


# -- where cards are placed, by how high they are

#: ``cards``: their names and rows of 4 px, in a main column and, if it is another height, in the last one.
columns = Script(
    {"ui/robot/columns.js": "placed"},
    """
    const STAGE = ["picture", 164, 164, { span: "main" }], DRIVE = ["drive", 165, 165, { side: true }];
    const END = ["engineers", 30, 30, { span: "all" }];
    const at = (count, cards, hasSide = true, homes) => {
      const sizes = cards.map(([id, rows, sideRows = rows, more]) => ({ id, rows, sideRows, ...more }));
      const places = placed(sizes, count, hasSide, homes && new Map(Object.entries(homes)));
      return Object.fromEntries(places.map((place, n) => [sizes[n].id, place]).slice(hasSide ? 2 : 0, -1));
    };
    """,
)
PLOTS = '["plots", 92, 146, { wide: true }]'
STATE, MAP = '["state", 68]', '["map", 108]'

# fmt: off
COLUMNS: Rows = {
    "a card goes where the columns end most alike": (
        f"result = at(2, [STAGE, DRIVE, {STATE}, {MAP}, END]);", {"state": [165, 1, 1], "map": [164, 0, 1]}),
    "what is wide spans columns that would stay empty": (
        f"result = at(3, [STAGE, DRIVE, {STATE}, {PLOTS}, END]);", {"state": [165, 2, 1], "plots": [164, 0, 2]}),
    "a card keeps its column, and what is below it moves": (
        f"result = at(2, [STAGE, DRIVE, {STATE.replace('68', '200')}, {MAP}, END], true,"
        "{ state: [[0, 1]], map: [[0, 1]] });", {"state": [164, 0, 1], "map": [364, 0, 1]}),
}
# fmt: on


# -- log lines

_BOOK = """
const book = new LogBook();
const lineOf = (line) => (typeof line === "string" ? { message: line } : line);
const take = (first, ...lines) => book.take({ origin: "a", first, lines: lines.map(lineOf) });
const texts = (filter) => book.filtered({ rank: 0, service: "", search: "", ...filter }).map((line) => line.text);
"""


book = Script({"core/logs.js": "LogBook, MOST"}, _BOOK, "result ??= texts();")


# fmt: off
BOOK: Rows = {
    "gaps are seen through every filter":
        ("take(1, 'a'); take(3, 'b'); result = texts({ search: 'nothing' });", ["… 1 line was dropped"]),
    "lines are taken once": (
        "take(1, 'a', 'b'); take(2, 'b', 'c'); take(1, 'a'); result = [texts(), book.cut];", [["a", "b", "c"], False]),
    "missing numbers are shown": (
        "take(4, 'a'); take(6, 'b'); take(19, 'c');",
        ["a", "… 1 line was dropped", "b", "… 12 lines were dropped", "c"]),
    "the newest 500 lines are there": (
        "for (let i = 1; i <= 700; i++) take(i, `${i}`); result = [texts().length, texts()[0], book.cut, MOST];",
        [500, "201", True, 500]),
    "lines are filtered by level service and text": ("""
        take(1, { level: "DEBUG", service: "imu", message: "d" },
             { level: "INFO", service: "bridge", message: "Hello" },
             { level: "odd", service: "imu:left", message: "o" }, { level: "ERROR", service: "imu2", message: "e" });
        result = [texts({ rank: 1 }), texts({ rank: 3 }), texts({ service: "imu" }), texts({ search: "hELLO" }),
                  texts({ search: "imu2" }), [...book.services]];""",
        [["Hello", "o", "e"], ["e"], ["d", "o"], ["Hello"], ["e"], ["imu", "bridge", "imu:left", "imu2"]]),
}
# fmt: on


# -- what can be done to a robot

NOT_OFFERED, NO_COMMAND = "This robot does not offer it", "Not set up on this robot"


lacks = Script({"ui/cards/system.js": "lacks"})
#: What is asked of a robot, its capabilities, and what it lacks.
LACKS: list[tuple[str, Any, str]] = [
    ("reboot", None, ""),
    ("reboot", {}, NOT_OFFERED),
    ("reboot", {"system": {"reboot": {"available": True, "controls": True}}}, ""),
    ("reboot", {"system": {"reboot": {"available": True, "controls": False}}}, NO_COMMAND),
    ("reboot", {"system": {"reboot": {"available": False, "controls": False}}}, NOT_OFFERED),
    ("git-pull", {"system": {"git_pull": {"controls": False}}}, NO_COMMAND),
]
LACKING: Rows = {
    f"{action} with {json.dumps(value)}": (f"result = lacks('{action}', {json.dumps(value)} ?? undefined);", why)
    for action, value, why in LACKS
}


# -- notices

_NOTICES = """
const notices = new Notices();
let at = 0;
const see = (ref, event, ...given) => notices.see(ref, event, (at += 10), ...given);
const texts = () => notices.list.map((notice) => `${notice.ref} ${notice.text}`);
const online = (ref, ...states) => states.forEach((state) => see(ref, "presence", state));
const level = (...levels) => levels.forEach(([percent, charging = false]) => see("a", "battery", percent, charging));
"""


notices = Script({"core/notices.js": "Notices, aloud, MOST"}, _NOTICES, "result ??= texts();")


UNPLUGGED = "a cannot be driven: no board"
#: States of *driveable*, those of a robot that is driven in capitals, and the notices.
DRIVEABLE = {
    "it is lost": ("YES NO", [UNPLUGGED]),
    "it comes back": ("YES NO YES", ["a can be driven again"]),
    "not known in between": ("YES UNKNOWN NO UNKNOWN yes", ["a can be driven again"]),
    "it was lost all the time": ("NO NO YES", []),
    "taken when it is lost": ("yes no NO YES", []),
}
# fmt: off
NOTICES: Rows = {
    "a contact of its charger that flaps is no charge": (
        "for (const charging of [false, true, true, false, true, false, false]) level([12, charging], [11, charging]);"
        "result = notices.fresh.length;", 1),
    "changes are listed":
        ("online('a', true, false); online('b', false, true);", ["b is online again", "a is offline"]),
    "of each robot the newest is listed": ("""
        for (let i = 0; i < 25; i++) online('a', true, false); online('b', true, false);
        result = [texts(), notices.unread, notices.list[1].at];""", [["b is offline", "a is offline"], 2, 500]),
    "stops are read aloud first, then the others as they came": ("""
        for (const name of ["a", "b", "c"]) online(name, true, false);
        for (const name of ["s", "a"]) for (const latched of [false, true]) see(name, "stop", { latched, by: "x" });
        result = aloud(notices.fresh, (ref) => ref.toUpperCase());""",
        "S was stopped by x. A was stopped by x. A is offline. B is offline. and 1 more"),
    "a stop that latches": ("""
        see("a", "stop", { latched: true, by: "x" }); see("b", "stop", { latched: false });
        see("b", "stop", { latched: true, by: "eve on phone" }); see("b", "stop", { latched: true, by: "bob" });
        see("c", "stop", { latched: false }); see("c", "stop", { latched: true });""",
        ["c was stopped by an unknown sender", "b was stopped by eve on phone"]),
    "a battery that hovers around the limit is listed once, and again once it was charged": ("""
        level([50], [19.5], [20.5], [18]); result = [...texts(), notices.fresh.length];
        level([30], [12], [21], [19], [21], [19]); result.push(notices.fresh.length);
        level(...Array(5).fill([30, true]), [12], [11]); level([90], [12], [11]); level([30], [12, true], [null]);
        result.push(notices.fresh.length);""", ["a has a low battery: 18 %", 1, 1, 3]),
    "a service that ends again and again": ("""
        const services = (state, restarts, last_exit) => see("a", "service", { imu: { state, restarts, last_exit } });
        const nine = "signal 9";
        services("ready", 3); services("ready", 3); services("restarting", 4, nine); services("ready", 4, nine);
        result = texts(); services("ready", 5, nine); services("failed", 5, "exit code 1");
        services("failed", 5, "exit code 1"); services("ready", 0); result.push(...texts(), notices.fresh.length);""",
        ["a service imu has ended, and is started again (signal 9)",
         "a service imu fails again and again (exit code 1)", 3]),
    "who asks for a robot": ("""
        for (const asks of ["", "otto", "otto"]) see("a", "asks", { you: true, asks });
        for (const asks of ["", "otto"]) see("b", "asks", { you: false, asks });""",
        ["a is wanted: otto asks to drive"]),
    **{f"of a robot that is driven, {what}": (f"""
        for (const one of "{states}".split(" "))
          see("a", "driveable", {{ state: one.toLowerCase(), why: "no board" }}, one < "a");""", expected)
        for what, (states, expected) in DRIVEABLE.items()},
    **{f"a state of any shape, {odd}": (f"""
        for (const event of ["presence", "stop", "asks", "script", "service", "driveable"])
          for (let i = 0; i < 2; i++) see("a", event, {odd}, true);""", [])
        for odd in ("null", "3", "{ services: 1, __proto__: null }")},
}
# fmt: on


@rows((looks, FACES), (columns, COLUMNS), (book, BOOK), (lacks, LACKING), (notices, NOTICES))
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


@pytest.mark.parametrize(("around", "together"), [("a{}b", 100), ("\u00e9{}\u00e9", 100), ("{}", 1), ("\u00e9{}", 1)])
def test_a_text_is_shown_as_in_a_terminal_whatever_character_is_in_it(around: str, together: int) -> None:
    """Those with a letter on each side are many in one text: no character sees further than that."""
    known = [chr(code) for code in range(sys.maxunicode + 1) if unicodedata.category(chr(code)) not in ("Cn", "Co")]
    each = [around.format(one) for one in some(known, 1 if together > 1 else 7)]
    texts = ["".join(each[first : first + together]) for first in range(0, len(each), together)]
    in_page = evaluate({"core/json.js": "visible"}, "result = given.map(visible);", texts)
    assert [pair for pair in zip(texts, in_page, strict=True) if pair[1] != shown(pair[0])] == []
