"""The page's lists of log lines and notices, in Node.js and virtual time."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from tests.ext.page.in_node import Rows, Script, rows

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
    "lines are taken once": ("take(1, 'a', 'b'); take(2, 'b', 'c'); take(1, 'a');", ["a", "b", "c"]),
    "missing numbers are shown": (
        "take(4, 'a'); take(6, 'b'); take(19, 'c');",
        ["a", "… 1 line was dropped", "b", "… 12 lines were dropped", "c"]),
    "those before the first one were not dropped: they are old": ("take(4, 'a'); result = book.cut;", True),
    "another origin may have other lines": (
        "take(1, 'a'); book.take({ origin: 'b', first: 3, lines: [{ message: 'z' }] });",
        ["a", "… lines may be missing here", "z"]),
    "gaps are seen through every filter":
        ("take(1, 'a'); take(3, 'b'); result = texts({ search: 'nothing' });", ["… 1 line was dropped"]),
    "the newest 500 lines are there": (
        "for (let i = 1; i <= 700; i++) take(i, `${i}`); result = [texts().length, texts()[0], book.cut, MOST];",
        [500, "201", True, 500]),
    "a cleared list shows what comes later": ("take(1, 'a'); book.clear(); take(1, 'a', 'b');", ["b"]),
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
    ("reboot", {"system": 3}, NOT_OFFERED),
    ("reboot", {"system": {"reboot": {"available": True, "controls": True}}}, ""),
    ("reboot", {"system": {"reboot": {"available": True, "controls": False}}}, NO_COMMAND),
    ("reboot", {"system": {"reboot": {"available": False, "controls": False}}}, NOT_OFFERED),
    ("reboot", {"reboot": {"controls": False}}, NO_COMMAND),
    ("reboot", {"reboot": True}, ""),
    ("service-restart", {"system": {"service-restart": {"topic": "x"}}}, ""),
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
    "it comes back after its driver has gone": ("YES NO yes", ["a can be driven again"]),
    "not known in between": ("YES UNKNOWN NO UNKNOWN YES", ["a can be driven again"]),
    "it was lost all the time": ("NO NO YES", []),
    "not driven": ("yes no yes", []),
    "taken when it is lost": ("yes no NO YES", []),
    "driven later": ("yes YES NO", [UNPLUGGED]),
    "not known": ("YES UNKNOWN", []),
    "another word": ("YES MAYBE NO", [UNPLUGGED]),
}
# fmt: off
NOTICES: Rows = {
    "only changes are listed":
        ("online('a', true, true, null, true); online('b', false, false); online('c', null, true);", []),
    "changes are listed":
        ("online('a', true, false); online('b', false, true);", ["b is online again", "a is offline"]),
    "of each robot the newest is listed": ("""
        for (let i = 0; i < 25; i++) online('a', true, false); online('b', true, false);
        result = [texts(), notices.unread, notices.list[1].at];""", [["b is offline", "a is offline"], 2, 500]),
    "the list is bounded and can be read": ("""
        for (let i = 0; i < 80; i++) online(`r${i}`, true, false);
        result = [notices.list.length, texts()[0], notices.unread, notices.fresh.length];
        notices.read(); online('z', true, false); result.push(notices.unread, notices.fresh.length);""",
        [50, "r79 is offline", 50, 50, 1, 1]),
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
    "a script that fails": ("""
        see("a", "script", { error: "old" }); see("a", "script", { running: true, file: "follow", error: null });
        see("a", "script", { running: false, error: { code: 1, toString: 1 } });
        see("b", "script", { running: true });
        see("b", "script", { running: false, error: "emergency stop", stopped: true });""",
        ['a script failed: {"code":1,"toString":1}']),
    "a battery that hovers around the limit is listed once, and again once it was charged": ("""
        level([50], [19.5], [20.5], [18]); result = [...texts(), notices.fresh.length];
        level([30], [12], [21], [19], [21], [19]); result.push(notices.fresh.length);
        level([30, true], [12], [11]); level([90], [12], [11]); level([30], [12, true], [null]);
        result.push(notices.fresh.length);""", ["a has a low battery: 18 %", 1, 1, 3]),
    "one reading of a battery is no event": ("level([80], [0], [80], [19], [26], [19], [80], [0]);", []),
    "a battery that is low from the begin is listed": ("level([19], [19]);", ["a has a low battery: 19 %"]),
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
        for odd in ("null", "3", "[]", '"x"', "{}", "{ services: 1, __proto__: null }")},
}
# fmt: on


@rows((book, BOOK), (lacks, LACKING), (notices, NOTICES))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
