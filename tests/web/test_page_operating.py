"""The page's lists of log lines and notices, and what is seen after an action; in Node.js and virtual time."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.web.test_page_core import run

# -- log lines

_BOOK = """
const book = new LogBook();
const take = (first, ...lines) => book.take({ origin: "a", first, lines });
const texts = (filter) => book.filtered({ rank: 0, service: "", search: "", ...filter }).map((line) => line.text);
"""


def book(steps: str) -> Any:
    return run("logs.js", "LogBook, MOST", _BOOK + steps + "\nresult ??= texts();")


def test_lines_are_taken_once() -> None:
    assert book("take(1, 'a', 'b'); take(2, 'b', 'c'); take(1, 'a');") == ["a", "b", "c"]


def test_missing_numbers_are_shown() -> None:
    assert book("take(4, 'a'); take(6, 'b'); take(19, 'c');") == [
        "a", "… 1 line was dropped", "b", "… 12 lines were dropped", "c",
    ]  # fmt: skip
    assert book("take(4, 'a'); result = book.cut;") is True  # those before were not dropped: they are old
    steps = "take(1, 'a'); book.take({ origin: 'b', first: 3, lines: ['z'] });"
    assert book(steps) == ["a", "… lines may be missing here", "z"]


def test_gaps_are_seen_through_every_filter() -> None:
    steps = "take(1, 'a'); take(3, 'b'); result = texts({ search: 'nothing' });"
    assert book(steps) == ["… 1 line was dropped"]


def test_the_newest_500_lines_are_there() -> None:
    steps = "for (let i = 1; i <= 700; i++) take(i, `${i}`); result = [texts().length, texts()[0], book.cut, MOST];"
    assert book(steps) == [500, "201", True, 500]


def test_a_cleared_list_shows_what_comes_later() -> None:
    assert book("take(1, 'a'); book.clear(); take(1, 'a', 'b');") == ["b"]


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
    assert run("logs.js", "lineOf", steps) == line


def test_lines_are_filtered_by_level_service_and_text() -> None:
    steps = """
    take(1, { level: "DEBUG", service: "imu", message: "d" }, { level: "INFO", service: "bridge", message: "Hello" },
         { level: "odd", service: "imu:left", message: "o" }, { level: "ERROR", service: "imu2", message: "e" });
    result = [texts({ rank: 1 }), texts({ rank: 3 }), texts({ service: "imu" }), texts({ search: "hELLO" }),
              texts({ search: "imu2" }), [...book.services]];"""
    assert book(steps) == [
        ["Hello", "o", "e"], ["e"], ["d", "o"], ["Hello"], ["e"], ["imu", "bridge", "imu:left", "imu2"],
    ]  # fmt: skip


# -- what is seen after an action

_OUTCOME = """
let now = 1000_000;
const clock = (ms) => String((ms - 1000_000) / 1000);
let outcome = new Outcome("service-restart", now, "base b1");
const state = { connected: true, online: true, heartbeatAt: null, boots: "base b1" };
const see = (seconds, changes) => { now += 1000 * seconds; outcome.see({ ...state, ...changes }, now); };
"""


def outcome(steps: str) -> Any:
    return run("outcome.js", "Outcome", _OUTCOME + steps + "\nresult ??= outcome.words(now, clock);")


def test_a_robot_that_goes_and_comes_back() -> None:
    steps = "see(3.5, { online: false, heartbeatAt: now + 3000 }); see(36, { online: false }); "
    assert outcome(steps) == ["asked 0", "heartbeat gone 3", "not back for 36 s"]
    assert outcome(steps + "see(0.5, {});") == ["asked 0", "heartbeat gone 3", "back 40"]
    assert outcome(steps + "see(0.5, {}); result = outcome.isOver(now);") is True


def test_programs_that_start_anew_are_seen_without_a_gap_of_the_heartbeat() -> None:
    assert outcome("see(2, { boots: 'base b2' });") == ["asked 0", "its programs have started anew 2"]


def test_only_after_30_s_nothing_has_happened() -> None:
    assert outcome("see(29, {});") == ["asked 0", "waiting…"]
    assert outcome("see(30, {});") == ["asked 0", "nothing changed for 30 s: the robot may not have done it"]
    assert outcome("see(30, {}); result = outcome.isOver(now);") is False


def test_what_was_not_seen_does_not_count() -> None:
    steps = "see(10, { connected: false }); see(40, { connected: false }); "
    assert outcome(steps) == ["asked 0", "not seen: there is no connection to the server"]
    assert outcome(steps + "see(5, { boots: '' });") == ["asked 0", "waiting…"]
    assert outcome(steps + "see(5, { online: null }); see(20, {});")[1].startswith("nothing changed for 30 s")


def test_an_old_heartbeat_is_not_earlier_than_the_request() -> None:
    assert outcome("see(1, { online: false, heartbeatAt: 5 });")[1] == "heartbeat gone 0"


def test_an_update_is_not_seen_by_heartbeats() -> None:
    steps = "outcome = new Outcome('git-pull', now); see(100, {});"
    assert outcome(steps) == ["asked 0", "heartbeats do not show an update: its log lines do"]
    assert outcome(steps + "see(100, {}); result = outcome.isOver(now);") is True


def test_a_refusal_is_the_end() -> None:
    assert outcome("outcome.refused = 'no'; result = [outcome.words(now, clock), outcome.isOver(now)];") == [
        ["not asked: no"], True,
    ]  # fmt: skip


def test_boots_are_compared_by_owner() -> None:
    owners = json.dumps([{"owner": "b", "boot": "1"}, {"owner": "a", "boot": "2"}])
    steps = f"result = [bootsOf({owners}), bootsOf(undefined), bootsOf('x')];"
    assert run("outcome.js", "bootsOf", steps) == ["a 2,b 1", "", ""]


NOT_OFFERED, NO_COMMAND = "This robot does not offer it", "This robot has no command for it in its config"


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
    assert run("outcome.js", "lacks", f"result = lacks({json.dumps(action)}, {value});") == why


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


def notices(steps: str) -> Any:
    return run("notices.js", "Notices, Watcher, MOST", _NOTICES + steps + "\nresult ??= texts();")


def test_only_changes_are_listed() -> None:
    assert notices("online('a', true, true, null, true); online('b', false, false); online('c', null, true);") == []
    assert notices("online('a', true, false); online('b', false, true);") == ["b is online again", "a is offline"]


def test_a_flapping_robot_is_one_line_with_a_count() -> None:
    steps = "for (let i = 0; i < 25; i++) online('a', true, false); online('b', true, false); "
    assert notices(steps) == ["b is offline", "a is offline 49x"]
    shown = notices(steps + "result = [notices.unread, notices.list[1].since, notices.list[1].at];")
    assert shown == [2, 20, 500]


def test_the_list_is_bounded_and_can_be_read_and_cleared() -> None:
    steps = "for (let i = 0; i < 80; i++) online(`r${i}`, true, false); "
    assert notices(steps + "result = [notices.list.length, texts()[0], notices.unread];") == [50, "r79 is offline", 50]
    assert notices(steps + "notices.read(); online('z', true, false); result = notices.unread;") == 1
    assert notices(steps + "notices.clear();") == []


def test_a_stop_that_latches() -> None:
    steps = """
    watcher.stop("a", { latched: true, by: "x" }, 1); watcher.stop("b", { latched: false }, 1);
    watcher.stop("b", { latched: true, by: "eve on phone" }, 2); watcher.stop("b", { latched: true, by: "bob" }, 3);
    watcher.stop("c", { latched: false }, 1); watcher.stop("c", { latched: true }, 2);"""
    assert notices(steps) == ["c was stopped by an unknown sender", "b was stopped by eve on phone"]


def test_a_script_that_fails() -> None:
    steps = """
    watcher.script("a", { running: false, error: "old" }, 1); watcher.script("a", { running: false, error: "old" }, 2);
    watcher.script("a", { running: true, file: "follow", error: null }, 3);
    watcher.script("a", { running: false, file: "follow", error: { code: 1, toString: 1 } }, 4);"""
    assert notices(steps) == ['a script follow failed: {"code":1,"toString":1}']


def test_a_service_that_ends_again_and_again() -> None:
    steps = """
    const services = (state, restarts, last_exit) =>
      watcher.services("a", { imu: { state, restarts, last_exit } }, ++at);
    services("ready", 3); services("ready", 3); services("restarting", 3, "signal 9"); services("ready", 4, "signal 9");
    const first = texts(); services("ready", 5, "signal 9"); services("failed", 5, "exit code 1");
    services("failed", 5, "exit code 1"); services("ready", 0); result = [first, texts()];"""
    first, last = notices(steps)
    assert first == ["a service imu has ended, and is started again (signal 9)"]
    assert last == ["a service imu fails again and again (exit code 1) 3x"]


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


@pytest.mark.parametrize(("states", "expected"), DRIVEABLE.values(), ids=DRIVEABLE)
def test_a_robot_that_is_driven_and_can_no_longer_be(states: str, expected: list[str]) -> None:
    reported = [[{"state": one.lower(), "why": "no board"}, one.isupper()] for one in states.split()]
    assert notices(f"for (const one of {json.dumps(reported)}) watcher.driveable('a', ...one, ++at);") == expected


def test_a_voltage_is_low_only_below_a_limit_of_the_user() -> None:
    assert notices("level(0.5); level(NaN); level('2');") == []
    steps = "const low = { limit: 7 }; level(7.2, low); level(6.9, low); level(7.01, low); level(6.8, low); "
    assert notices(steps) == ["a has a low battery: 6.9 V, below 7"]
    assert notices(steps + "level(7.2, low); level(6.5, low);") == ["a has a low battery: 6.5 V, below 7 2x"]
    assert notices(steps + "notices.clear(); level(6.5, { ...low, charging: true });") == []


def test_per_cent_are_low_below_20_unless_the_user_has_another_limit() -> None:
    assert notices("level(19.5, { unit: '%' });") == ["a has a low battery: 19.5 %, below 20"]
    assert notices("level(15, { unit: '%', limit: 10 });") == []


@pytest.mark.parametrize("odd", ["null", "3", "[]", '"x"', "{}", "{ services: 1, __proto__: null }"])
def test_states_of_any_shape_are_no_notices(odd: str) -> None:
    calls = f"watcher[name]('a', {odd}, 1); watcher.driveable('a', {odd}, true, 1);"
    steps = f"for (const name of ['online', 'stop', 'script', 'services']) {{ {calls} }}"
    assert notices(steps) == []
