"""The page's lists of log lines and notices, and what is seen after an action; in Node.js and virtual time."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from tests.web.in_node import Rows, Script, evaluate, rows

# -- log lines

_BOOK = """
const book = new LogBook();
const take = (first, ...lines) => book.take({ origin: "a", first, lines });
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
        "take(1, 'a'); book.take({ origin: 'b', first: 3, lines: ['z'] });",
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


@pytest.mark.parametrize(
    ("raw", "line"),
    [
        ({"t": 5, "level": "warn", "service": "imu", "message": "[imu] x"}, [5, "WARNING", "imu", "x"]),
        ({"value": {"t": 5, "level": "ERROR", "msg": "x"}}, [5, "ERROR", "", "x"]),
        ({"t": 7, "value": "x"}, [7, "", "", "x"]),
        ({"timestamp": 2, "message": 3}, [2000, "", "", "3"]),
        ("plain text", [None, "", "", "plain text"]),
        (None, [None, "", "", ""]),
        ([1, {"a": 2}], [None, "", "", '[1,{"a":2}]']),
        ({"t": "soon", "level": {}, "service": [], "message": {"a": 1}}, [None, "", "", '{"a":1}']),
        ({"t": 1e300, "level": "constructor", "message": "x"}, [None, "CONSTRUCTOR", "", "x"]),
        ({"toString": 1, "a": 2}, [None, "", "", '{"toString":1,"a":2}']),
        ({"message": "x" * 5000}, [None, "", "", "x" * 4000 + "…"]),
    ],
)
def test_a_line_may_be_of_any_shape(raw: object, line: list[object]) -> None:
    steps = f"const one = lineOf({json.dumps(raw)}, 1); result = [one.t, one.level, one.service, one.text];"
    assert evaluate({"core/logs.js": "lineOf"}, steps) == line


# -- what is seen after an action

_OUTCOME = """
let now = 1000_000;
const clock = (ms) => String((ms - 1000_000) / 1000);
let outcome = new Outcome("service-restart", now, "base b1");
const state = { connected: true, online: true, heartbeatAt: null, boots: "base b1" };
const words = () => outcome.words(now, clock);
const see = (seconds, changes) => { now += 1000 * seconds; outcome.see({ ...state, ...changes }, now); };
"""


outcome = Script({"core/outcome.js": "Outcome"}, _OUTCOME, "result ??= words();")


# fmt: off
OUTCOME: Rows = {
    "a robot that goes and comes back": ("""
        see(3.5, { online: false, heartbeatAt: now + 3000 }); see(36, { online: false }); result = [words().at(-1)];
        see(0.5, {}); result.push(words(), outcome.isOver(now));""",
        ["not back for 36 s", ["asked 0", "heartbeat gone 3", "back 40"], True]),
    "programs that start anew are seen without a gap of the heartbeat":
        ("see(2, { boots: 'base b2' });", ["asked 0", "its programs have started anew 2"]),
    "only after 30 s nothing has happened": ("see(29, {});", ["asked 0", "waiting…"]),
    "after 30 s nothing has happened": (
        "see(30, {}); result = [words(), outcome.isOver(now)];",
        [["asked 0", "nothing changed for 30 s: the robot may not have done it"], False]),
    "an update is not seen by heartbeats": (
        "outcome = new Outcome('git-pull', now); see(100, {}); result = [...words(), outcome.isOver(now + 1e5)];",
        ["asked 0", "heartbeats do not show an update: its log lines do", True]),
    "what was not seen does not count": ("""
        see(10, { connected: false }); see(40, { connected: false }); result = [words().at(-1)];
        see(5, { boots: '' }); result.push(words().at(-1));""",
        ["not seen: there is no connection to the server", "waiting…"]),
    "only what was seen counts": (
        "see(10, { connected: false }); see(40, { connected: false }); see(5, { online: null }); see(20, {});",
        ["asked 0", "nothing changed for 30 s: the robot may not have done it"]),
    "an old heartbeat is not earlier than the request": (
        "see(1, { online: false, heartbeatAt: 5 }); result = words()[1];", "heartbeat gone 0"),
    "a refusal is the end": (
        "outcome.refused = 'no'; result = [words(), outcome.isOver(now)];", [["not asked: no"], True]),
}
# fmt: on


def test_boots_are_compared_by_owner() -> None:
    owners = json.dumps([{"owner": "b", "boot": "1"}, {"owner": "a", "boot": "2"}])
    steps = f"result = [bootsOf({owners}), bootsOf(undefined), bootsOf('x')];"
    assert evaluate({"core/outcome.js": "bootsOf"}, steps) == ["a 2,b 1", "", ""]


NOT_OFFERED, NO_COMMAND = "This robot does not offer it", "Not set up on this robot"


@pytest.mark.parametrize(
    ("action", "capabilities", "why"),
    [
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
    ],
)
def test_what_a_robot_lacks_in_every_spelling(action: str, capabilities: object, why: str) -> None:
    value = "undefined" if capabilities is None else json.dumps(capabilities)
    assert evaluate({"core/outcome.js": "lacks"}, f"result = lacks({json.dumps(action)}, {value});") == why


# -- notices

_NOTICES = """
const notices = new Notices();
const watcher = new Watcher(notices);
let at = 0;
const texts = () => notices.list.map((one) => `${one.ref} ${one.text}${one.count > 1 ? ` ${one.count}x` : ""}`);
const online = (ref, ...states) => states.forEach((state) => watcher.online(ref, state, (at += 10)));
const level = (value, more = {}) =>
  watcher.battery("a", { value, unit: "V", charging: false, limit: null, ...more }, (at += 10));
"""


notices = Script({"core/notices.js": "Notices, Watcher, aloud, MOST"}, _NOTICES, "result ??= texts();")


UNPLUGGED = "a cannot be driven: no board"
#: States of *driveable*, those of a robot that is driven in capitals, and the notices.
DRIVEABLE = {
    "it is lost": ("YES NO", [UNPLUGGED]),
    "it comes back": ("YES NO YES", ["a can be driven again 2x"]),
    "it comes back after its driver has gone": ("YES NO yes", ["a can be driven again 2x"]),
    "again and again": ("YES NO YES NO", [f"{UNPLUGGED} 3x"]),
    "not known in between": ("YES UNKNOWN NO UNKNOWN YES", ["a can be driven again 2x"]),
    "it was lost all the time": ("NO NO YES", []),
    "not driven": ("yes no yes", []),
    "taken when it is lost": ("yes no NO YES", []),
    "driven later": ("yes YES NO", [UNPLUGGED]),
    "said once": ("YES NO NO NO", [UNPLUGGED]),
    "not known": ("YES UNKNOWN", []),
    "another word": ("YES MAYBE NO", [UNPLUGGED]),
}
# fmt: off
NOTICES: Rows = {
    "only changes are listed":
        ("online('a', true, true, null, true); online('b', false, false); online('c', null, true);", []),
    "changes are listed":
        ("online('a', true, false); online('b', false, true);", ["b is online again", "a is offline"]),
    "a flapping robot is one line with a count": ("""
        for (let i = 0; i < 25; i++) online('a', true, false); online('b', true, false);
        result = [texts(), notices.unread, notices.list[1].since, notices.list[1].at];""",
        [["b is offline", "a is offline 49x"], 2, 20, 500]),
    "the list is bounded and can be read and cleared": ("""
        for (let i = 0; i < 80; i++) online(`r${i}`, true, false);
        result = [notices.list.length, texts()[0], notices.unread];
        notices.read(); online('z', true, false); result.push(notices.unread);
        notices.clear(); result.push(texts());""", [50, "r79 is offline", 50, 1, []]),
    "stops are read aloud first, then the others as they came": ("""
        for (const name of ["a", "b", "c"]) online(name, true, false);
        for (const name of ["s", "t"]) for (const latched of [false, true]) watcher.stop(name, { latched, by: "x" }, 1);
        result = aloud(notices.list, (ref) => ref.toUpperCase());""",
        "S was stopped by x. T was stopped by x. A is offline. B is offline. and 1 more"),
    "one that comes again is a newer one": (
        "online('a', true, false, true); online('b', true, false); result = notices.list.map((one) => one.number);",
        [3, 2]),
    "a stop that latches": ("""
        watcher.stop("a", { latched: true, by: "x" }, 1); watcher.stop("b", { latched: false }, 1);
        watcher.stop("b", { latched: true, by: "eve on phone" }, 2); watcher.stop("b", { latched: true, by: "bob" }, 3);
        watcher.stop("c", { latched: false }, 1); watcher.stop("c", { latched: true }, 2);""",
        ["c was stopped by an unknown sender", "b was stopped by eve on phone"]),
    "a script that fails": ("""
        for (const at of [1, 2]) watcher.script("a", { running: false, error: "old" }, at);
        watcher.script("a", { running: true, file: "follow", error: null }, 3);
        watcher.script("a", { running: false, file: "follow", error: { code: 1, toString: 1 } }, 4);""",
        ['a script follow failed: {"code":1,"toString":1}']),
    "a voltage is low only below a limit of the user": ("level(0.5); level(NaN); level('2');", []),
    "a voltage that stays low is listed once, and again once it was higher": ("""
        const low = { limit: 7 }; for (const one of [7.2, 6.9, 7.01, 6.8]) level(one, low);
        result = texts(); level(7.2, low); level(6.5, low); result.push(...texts());
        notices.clear(); level(6.5, { ...low, charging: true }); result.push(...texts());""",
        ["a has a low battery: 6.9 V, below 7", "a has a low battery: 6.5 V, below 7 2x"]),
    "per cent are low below 20": ("level(19.5, { unit: '%' });", ["a has a low battery: 19.5 %, below 20"]),
    "per cent are low below a limit of the user": ("level(15, { unit: '%', limit: 10 });", []),
    "a service that ends again and again": ("""
        const services = (state, restarts, last_exit) =>
          watcher.services("a", { imu: { state, restarts, last_exit } }, ++at);
        const nine = "signal 9";
        services("ready", 3); services("ready", 3); services("restarting", 3, nine); services("ready", 4, nine);
        result = texts(); services("ready", 5, nine); services("failed", 5, "exit code 1");
        services("failed", 5, "exit code 1"); services("ready", 0); result.push(...texts());""",
        ["a service imu has ended, and is started again (signal 9)",
         "a service imu fails again and again (exit code 1) 3x"]),
    **{f"of a robot that is driven, {what}": (f"""
        for (const one of "{states}".split(" "))
          watcher.driveable("a", {{ state: one.toLowerCase(), why: "no board" }}, one < "a", ++at);""", expected)
        for what, (states, expected) in DRIVEABLE.items()},
    **{f"a state of any shape, {odd}": (f"""
        for (const name of ["online", "stop", "script", "services"]) watcher[name]("a", {odd}, 1);
        watcher.driveable("a", {odd}, true, 1);""", [])
        for odd in ("null", "3", "[]", '"x"', "{}", "{ services: 1, __proto__: null }")},
}
# fmt: on


@rows((book, BOOK), (outcome, OUTCOME), (notices, NOTICES))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
