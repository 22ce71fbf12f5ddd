"""What is behind the cards Lights, Sounds and Autonomy, without a browser: in Node.js."""

from __future__ import annotations

import itertools
import json
from typing import Any

import pytest

from pebble.services.autonomy_manager.forms import Setting, SettingError, effective
from tests.web.test_page_core import run

BASE = "pebble/robots/goob"


#: The services of a page before one robot; ``sent`` is what it asks for.
_PAGE = """
const ref = "pebble/robots/goob";
const values = {
  "": { "web/broker": { problem: "" } },
  [ref]: {
    "web/liveness": { online: true },
    capabilities: { value: {
      lights: { solid: true, flash: true }, soundboard: { available: true, controls: true },
      autonomy: { available: true, controls: true }, drive: { available: true, arbitrates: true },
    } },
  },
};
const sent = [];
const followers = new Set();
const onChange = (fn) => { followers.add(fn); return () => followers.delete(fn); };
const page = {
  connection: { isOpen: true, may: (right) => right === "drive", answers: new Map(), onChange },
  store: { get: (at, metric) => (metric in (values[at] ?? {}) ? { value: values[at][metric] } : undefined) },
  commands: {
    setLights: (_ref, colour) => sent.push(colour),
    playSound: (_ref, file, repeat) => sent.push([file, repeat]),
  },
};
"""

# -- lights

BLACK = {"r": 0, "g": 0, "b": 0}


def lights(steps: str) -> Any:
    names = "Lights, Pacer, command, lightsOf, supported, toggleFlash, whyNotLights"
    return run("../ui/cards/lights-model.js", names, _PAGE + steps)


_PACER = """
let now = 1000;
const timers = [];
const pacer = new Pacer(200, () => now, (fn, ms) => timers.push([fn, now + ms]));
const calls = [];
const drag = (ms, value) => {
  while (timers.length && timers[0][1] <= now + ms) { const [fn, at] = timers.shift(); ms -= at - now; now = at; fn(); }
  now += ms;
  if (value !== undefined) pacer.call(() => calls.push([now, value]));
};
"""


def test_a_dragged_colour_is_sent_five_times_a_second_and_the_last_one_always() -> None:
    calls = lights(_PACER + "for (let i = 0; i < 100; i++) drag(10, i); drag(1000); result = calls;")
    times = [at for at, _ in calls]
    assert min(later - at for at, later in itertools.pairwise(times)) >= 200
    assert len(calls) == 6
    assert calls[0] == [1010, 0]
    assert calls[-1][1] == 99


def test_single_choices_are_sent_at_once() -> None:
    assert lights(_PACER + "drag(0, 1); drag(200, 2); drag(500, 3); result = [calls, timers.length];") == [
        [[1000, 1], [1200, 2], [1700, 3]], 0,
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ('{ mode: "solid" }', {"r": 1, "g": 0.533, "b": 0}),
        ('{ colour: "#0000ff" }', {"r": 0, "g": 0, "b": 1}),
        ('{ mode: "flash", period: 0.5 }', {"r": 1, "g": 0.533, "b": 0, "period": 0.5}),
        ('{ mode: "flash", period: 99 }', {"r": 1, "g": 0.533, "b": 0, "period": 10}),
        ('{ mode: "flash", period: NaN }', {"r": 1, "g": 0.533, "b": 0, "period": 2}),
        ('{ mode: "off" }', BLACK),
        ('{ colour: "red" }', {"r": 1, "g": 0.533, "b": 0}),
    ],
)
def test_what_is_asked_of_lights(change: str, expected: dict[str, float]) -> None:
    assert lights(f"lightsOf(ref).ask(page, {change}); result = sent;") == [expected]


def test_lights_that_only_flash_are_off_in_black() -> None:
    steps = "values[ref].capabilities.value.lights = { solid: false, flash: true };"
    assert lights(f'{steps} lightsOf(ref).ask(page, {{ mode: "off" }}); result = sent;') == [BLACK | {"period": 2}]


@pytest.mark.parametrize(("before", "after"), [("solid", "solid"), ("off", "off")])
def test_a_flash_ends_in_what_was_before(before: str, after: str) -> None:
    steps = f"""
    const one = lightsOf(ref);
    one.ask(page, {{ mode: "{before}" }});
    result = [toggleFlash(page, ref), one.mode, toggleFlash(page, ref), one.mode];"""
    assert lights(steps) == ["", "flash", "", after]


_ANSWER = """
const answer = (n, op) => { page.connection.answers.set(n, { op, n }); [...followers].forEach((fn) => fn()); };
const one = lightsOf(ref);
const lit = () => [one.mode, one.colour];
"""


def test_lights_that_were_refused_are_as_before() -> None:
    steps = """
    one.ask(page, { mode: "solid", colour: "#0000ff" });
    answer(1, "done");
    one.pacer.calledAt = -Infinity;
    result = [toggleFlash(page, ref), lit()];
    answer(2, "refused");
    result.push(lit(), followers.size);
    one.pacer.calledAt = -Infinity;
    page.commands.setLights = () => 0;
    one.ask(page, { mode: "off" });
    result.push(lit());"""
    blue = ["solid", "#0000ff"]
    assert lights(_ANSWER + steps) == ["", ["flash", "#0000ff"], blue, 0, blue]


def test_a_refusal_does_not_undo_what_was_asked_after_it() -> None:
    steps = """
    one.ask(page, { mode: "solid" });
    one.pacer.calledAt = -Infinity;
    one.ask(page, { mode: "off" });
    answer(1, "refused");
    result = [lit()[0]];
    answer(2, "done");
    result.push(lit()[0], followers.size);"""
    assert lights(_ANSWER + steps) == ["off", "off", 0]


def test_a_flash_of_a_silent_robot_can_be_switched_off() -> None:
    steps = """
    const one = lightsOf(ref);
    one.ask(page, { mode: "flash" });
    values[ref]["web/liveness"].online = false;
    result = [toggleFlash(page, ref), one.mode, toggleFlash(page, ref)];"""
    assert lights(steps) == ["", "off", "goob is silent"]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("page.connection.isOpen = false", "No connection to the server"),
        ('values[""]["web/broker"].problem = "refused"', "The server cannot reach the broker"),
        ("page.connection.may = () => false", "Log in as driver to use this"),
        ('values[ref]["web/liveness"].online = false', "goob is silent"),
        ("values[ref].capabilities.value.lights.controls = false", "goob takes no such commands"),
        ("values[ref].capabilities.value.lights.flash = false", "goob has no lights that flash"),
        ("values[ref].capabilities.value.lights = 7", "goob has no lights that flash"),
        ("values[ref].capabilities = null", "goob has no lights that flash"),
        ("delete values[ref]", "goob has no lights that flash"),
    ],
)
def test_why_lights_do_not_flash(change: str, why: str) -> None:
    assert lights(f"{change}; result = [toggleFlash(page, ref), sent];") == [why, []]


@pytest.mark.parametrize(
    ("section", "expected"),
    [
        ({"solid": True, "flash": True}, [True, True]),
        ({"solid": True, "flash": False}, [True, False]),
        ({"available": True}, [True, True]),
        ({"available": True, "flash": False}, [True, False]),
        ({"solid": "yes", "available": 1}, [False, False]),
        ({}, [False, False]),
    ],
)
def test_what_lights_can_do(section: dict[str, Any], expected: list[bool]) -> None:
    steps = f"const can = supported({{ value: {{ lights: {json.dumps(section)} }} }}); result = [can.solid, can.flash];"
    assert lights(steps) == expected


@pytest.mark.parametrize(
    "stored", ["null", "7", '"x"', "[]", '{"colour":"url(x)","period":"2","mode":"boom","steady":[]}']
)
def test_lights_ignore_what_they_cannot_have_remembered(stored: str) -> None:
    steps = f"""
    globalThis.localStorage = {{ getItem: () => {json.dumps(stored)}, setItem() {{}} }};
    const {{ colour, period, mode, steady }} = new Lights("other");
    result = [colour, period, mode, steady];"""
    assert lights(steps) == ["#ff8800", 2, "", "off"]


# -- sounds


def sounds(steps: str) -> Any:
    return run("../ui/cards/sounds-model.js", "clips, grouped, play, playing, repeatLast, soundsOf", _PAGE + steps)


def test_the_last_sound_is_repeated_as_it_was_played() -> None:
    steps = """
    result = [repeatLast(page, ref), play(page, ref, "a/horn.wav", true), repeatLast(page, ref),
      repeatLast(page, "pebble/robots/fred"), sent];"""
    played = ["a/horn.wav", True]
    assert sounds(steps) == ["Play one sound first", "", "", "Play one sound first", [played, played]]


def test_what_cannot_be_played_is_not_repeated() -> None:
    steps = """
    result = [play(page, ref, "x".repeat(1001), false), repeatLast(page, ref)];
    values[ref].capabilities.value.soundboard.controls = false;
    result.push(play(page, ref, "horn.wav", false), repeatLast(page, ref), sent);"""
    refused = "goob takes no such commands"
    assert sounds(steps) == ["Its name is too long", "Play one sound first", refused, refused, []]


FILES = ["horn.wav", "Bell.wav", "animals/Cat.wav", "animals/dog.wav", "animals/wild/cat.wav"]


@pytest.mark.parametrize(
    ("words", "most", "folders", "more"),
    [
        ("", 60, [["", FILES[:2]], ["animals/", FILES[2:4]], ["animals/wild/", FILES[4:]]], 0),
        ("CAT", 60, [["animals/", FILES[2:3]], ["animals/wild/", FILES[4:]]], 0),
        ("  wild   cat ", 60, [["animals/wild/", FILES[4:]]], 0),
        ("nothing", 60, [], 0),
        ("", 2, [["", FILES[:2]]], 3),
    ],
)
def test_clips_are_grouped_by_folder_and_bounded(words: str, most: int, folders: list[Any], more: int) -> None:
    found = sounds(f"result = grouped({json.dumps(FILES)}, {json.dumps(words)}, {most});")
    assert found == {"folders": folders, "more": more}


@pytest.mark.parametrize(
    ("payload", "expected"),
    [
        ({"files": ["a.wav", "a.wav", 7, None, "", "  ", ["b.wav"], "c.wav"]}, ["a.wav", "c.wav"]),
        ({"value": {"files": ["a.wav"]}}, ["a.wav"]),
        ({"files": "a.wav"}, None),
        ({"files": {"0": "a.wav"}}, None),
        (None, None),
        (7, None),
    ],
)
def test_only_names_are_clips(payload: Any, expected: Any) -> None:
    assert sounds(f"result = clips({json.dumps(payload)});") == expected


@pytest.mark.parametrize(
    ("payload", "expected"),
    [
        ({"playing": True, "file": "a.wav", "error": None}, ["a.wav", ""]),
        ({"playing": True, "file": {"x": 1}, "error": 7}, ["a clip", ""]),
        ({"playing": "yes", "file": "a.wav", "error": "Sound file not found"}, ["", "Sound file not found"]),
        ([], ["", ""]),
        (None, ["", ""]),
    ],
)
def test_what_plays(payload: Any, expected: list[str]) -> None:
    assert sounds(f"const {{ file, error }} = playing({json.dumps(payload)}); result = [file, error];") == expected


# -- forms of scripts


def forms(steps: str) -> Any:
    names = "filled, hint, lastScript, mistake, remember, remembered, scripts, whyNotSent"
    return run("../ui/cards/form-model.js", names, steps)


def entry(key: str, kind: str = "string", **more: Any) -> dict[str, Any]:
    return {"key": key, "label": key.upper(), "type": kind, "default": None, "arg": f"--{key}"} | more


def filled_all(configs: list[Any], forms_: list[dict[str, str]]) -> list[Any]:
    """What is sent of each form, and its mistakes."""
    files = {"files": [{"file": "x", "label": "X", "configs": configs}]}
    steps = f"""
    const [script] = scripts({json.dumps(files)});
    result = JSON.parse({json.dumps(json.dumps(forms_))}).map((texts) => {{
      const {{ config, mistakes }} = filled(script.fields, new Map(Object.entries(texts)));
      return [config, Object.fromEntries(mistakes)];
    }});"""
    found: list[Any] = forms(steps)
    return found


def filled(configs: list[Any], texts: dict[str, str]) -> tuple[dict[str, Any], dict[str, str]]:
    ((config, mistakes),) = filled_all(configs, [texts])
    return config, mistakes


ALL = [
    entry("name", default="goob"),
    entry("laps", "int", default=3, min=1, max=9, step=1),
    entry("power", "float", default=0.5, min=0.1, max=1.0),
    entry("search", "bool", default=True),
    entry("family", "enum", default="A", options=["A", "B"]),
    entry("tag", "int", required=True),
]


def test_what_was_not_filled_in_is_not_sent() -> None:
    assert filled(ALL, {"tag": "7"}) == ({"tag": 7}, {})


def test_what_was_filled_in_has_the_types_of_json() -> None:
    texts = {"name": "fred", "laps": "4", "power": "0.25", "search": "false", "family": "B", "tag": "0", "foreign": "x"}
    expected = {"name": "fred", "laps": 4, "power": 0.25, "search": False, "family": "B", "tag": 0}
    assert filled(ALL, texts) == (expected, {})


MISTAKES = [
    ("tag", "", "required"),
    ("laps", "0", "at least 1"),
    ("laps", "10", "at most 9"),
    ("laps", "2.5", "must be a whole number"),
    ("laps", "?", "must be a number"),
    ("laps", " ", "must be a number"),
    ("laps", "two", "must be a number"),
    ("tag", "1e15", "must be a whole number"),
    ("power", "1e999", "must be a number"),
    ("power", "NaN", "must be a number"),
    ("power", "Infinity", "must be a number"),
    ("power", "0.05", "at least 0.1"),
    ("name", "-x", "must not begin with -"),
    ("name", "x" * 257, "at most 256 characters"),
    ("name", "a\tb", "must have no control characters"),
    ("name", "a\u00a0b", "must have no control characters"),
    ("family", "C", "choose one of the list"),
    ("search", "maybe", "choose one of the list"),
]


def test_mistakes() -> None:
    found = filled_all(ALL, [{"tag": "1"} | {key: text} for key, text, _ in MISTAKES])
    for (key, text, mistake), (config, mistakes) in zip(MISTAKES, found, strict=True):
        assert mistakes == {key: mistake}, (key, text)
        assert key not in config


def test_texts_that_robots_accept() -> None:
    texts = ["naïve café", "日本", "a b", "3-4", "{}"]
    found = filled_all(ALL, [{"name": text, "tag": "1"} for text in texts])
    assert found == [[{"name": text, "tag": 1}, {}] for text in texts]


SETTINGS = [
    Setting(key="laps", type="int", default=3, min=1, max=9),
    Setting(key="power", type="float", default=0.5, min=0.1, max=1),
    Setting(key="name", type="string", default="x"),
    Setting(key="family", type="enum", default="A", options=("A", "B")),
]
TEXTS = [
    "1",
    "9",
    "10",
    "0",
    "2.5",
    "-1",
    "1e0",
    ".5",
    "5.",
    "1e-1",
    "A",
    "C",
    "1_0",
    "٣",
    "x" * 256,
    "x" * 257,
    "a\nb",
    " ",
]


def robot_accepts(values: dict[str, Any]) -> bool:
    try:
        effective(SETTINGS, values)
    except SettingError:
        return False
    return True


def test_the_form_and_the_robot_accept_the_same() -> None:
    cases = [(setting.key, text) for setting in SETTINGS for text in TEXTS]
    found = filled_all([setting.entry() for setting in SETTINGS], [{key: text} for key, text in cases])
    for (key, text), (config, mistakes) in zip(cases, found, strict=True):
        assert robot_accepts(config or {key: text}) is not bool(mistakes), (key, text)


def test_a_robot_may_list_anything() -> None:
    odd: list[Any] = [
        7, None, [], {"key": 1}, {"key": ""}, {"key": "x" * 101}, {"key": "a"},
        entry("a", "colour", default={"x": 1}, min="0"),
        entry("b", "int", default="3", min="0", max=None, step=-1, required="yes"), entry("c", "enum", options="abc"),
        entry("d", "enum", options=[1, 1, {"x": 1}, "two"], default=7), entry("__proto__", "int"),
        entry("e", "bool", default=None, required=True), {"key": "f", "label": ["x"], "type": None},
    ]  # fmt: skip
    files = {"files": [{"file": "x", "configs": odd}, {"file": 7}, "y", {"file": "z", "label": 1, "configs": "none"}]}
    found = forms(f"result = scripts({json.dumps(files)});")
    assert [one["file"] for one in found] == ["x", "z"]
    fields = {one["key"]: one for one in found[0]["fields"]}
    assert list(fields) == ["a", "b", "c", "d", "__proto__", "e", "f"]
    assert [one["type"] for one in fields.values()] == ["text", "int", "text", "enum", "int", "bool", "text"]
    assert (fields["b"]["min"], fields["b"]["step"], fields["b"]["required"], fields["b"]["default"]) == (
        None,
        None,
        False,
        "3",
    )
    assert (fields["d"]["options"], fields["d"]["default"]) == (["1", "two"], "7")
    assert fields["f"]["label"] == "f"
    assert found[0]["omitted"] == len(odd) - 7
    assert filled(odd, {"__proto__": "3", "e": "true"})[0] == {"__proto__": 3, "e": True}


@pytest.mark.parametrize("payload", [None, 7, [], {}, {"files": None}, {"value": 3}])
def test_without_a_list_there_are_no_scripts(payload: Any) -> None:
    assert forms(f"result = scripts({json.dumps(payload)});") is None


def test_scripts_of_the_same_label_have_their_folder_beside_it() -> None:
    files = {
        "files": [{"file": "a", "label": "Follow"}, {"file": "b", "label": "Follow"}, {"file": "c", "label": "Go"}]
    }
    found = forms(f"result = scripts({json.dumps(files)});")
    assert [one["label"] for one in found] == ["Follow (a)", "Follow (b)", "Go"]


def test_a_form_with_mistakes_is_not_sent() -> None:
    steps = """
    const reasons = (mistakes, config = {}) => whyNotSent({ config, mistakes: new Map(mistakes) });
    const long = Object.fromEntries([...Array(64).keys()].map((n) => [`k${n}`, "x".repeat(256)]));
    result = [reasons([]), reasons([["a", "x"]]), reasons([["a", "x"], ["b", "y"]]), reasons([], long)];"""
    assert forms(steps) == [
        "", "The form has 1 mistake", "The form has 2 mistakes", "The settings are too long together",
    ]  # fmt: skip


HINTS = [
    (entry("a", "int", min=1, max=9, default=3), "a whole number, 1 to 9, default 3"),
    (entry("a", "float", min=0.5), "at least 0.5"),
    (entry("a", "float", max=2, default=1.5), "at most 2, default 1.5"),
    (entry("a", "bool", default=False), "default off"),
    (entry("a"), ""),
]


def test_hints() -> None:
    configs = [field | {"key": f"k{number}"} for number, (field, _) in enumerate(HINTS)]
    files = {"files": [{"file": "x", "configs": configs}]}
    found = forms(f"result = scripts({json.dumps(files)})[0].fields.map(hint);")
    assert found == [expected for _, expected in HINTS]


_STORED = """
const stored = new Map();
const getItem = (key) => stored.get(key) ?? null;
globalThis.localStorage = { getItem, setItem: (key, value) => stored.set(key, value) };
const texts = (map) => Object.fromEntries(map);
"""


def test_forms_are_remembered_by_robot_and_script() -> None:
    steps = """
    remember("goob", "a", new Map([["x", "1"]]));
    remember("goob", "b", new Map([["x", "2"], ["y", "?"]]));
    remember("fred", "a", new Map([["x", "3"]]));
    result = [texts(remembered("goob", "a")), texts(remembered("goob", "b")), texts(remembered("fred", "b")),
      lastScript("goob"), lastScript("fred"), lastScript("lamp")];"""
    assert forms(_STORED + steps) == [{"x": "1"}, {"x": "2"}, {}, "b", "a", ""]


def test_the_memory_of_forms_is_bounded() -> None:
    steps = """
    for (let n = 0; n < 40; n++) remember("goob", `script ${n}`, new Map([["x", "y".repeat(200)]]));
    const many = JSON.parse(stored.get("pebble forms")).length;
    for (let n = 0; n < 40; n++) remember("goob", `script ${n}`, new Map([["x", "y".repeat(20000)]]));
    result = [many, stored.get("pebble forms").length < 60000, texts(remembered("goob", "script 39")).x.length];"""
    assert forms(_STORED + steps) == [32, True, 20000]


@pytest.mark.parametrize("stored", ["{", "7", '{"a":1}', '[[1,2,3],["goob","a",{"x":1}],["goob","a",[["x",1]]],null]'])
def test_a_memory_of_something_else_is_none(stored: str) -> None:
    steps = f"{_STORED} stored.set('pebble forms', {json.dumps(stored)});"
    assert forms(f"{steps} result = [texts(remembered('goob', 'a')), lastScript('goob')];") == [{}, ""]


# -- what may be asked

MAINTAINER = "Log in as maintainer to use this"


@pytest.mark.parametrize(
    ("change", "whys"),
    [
        ("", ["", "", MAINTAINER]),
        ("page.connection.may = () => true", ["", "", ""]),
        ("page.connection.may = () => false", ["Log in as driver to use this"] * 2 + [MAINTAINER]),
        ('values[ref]["web/liveness"].online = false', ["", "goob is silent", MAINTAINER]),
        ('values[""]["web/broker"].problem = "x"', ["", "The server cannot reach the broker", MAINTAINER]),
        ('values[""]["web/broker"].connected = false', ["The server cannot reach the broker"] * 3),
        ("page.connection.isOpen = false", ["No connection to the server"] * 3),
    ],
)
def test_what_ends_something_may_be_asked_of_a_silent_robot(change: str, whys: list[str]) -> None:
    steps = f'{change}; result = [whyNotEnd(page), whyNot(page, ref), whyNot(page, ref, "", "system")];'
    assert run("../ui/parts/why-not.js", "whyNot, whyNotEnd", _PAGE + steps) == whys


def test_the_newest_answers_are_remembered_by_the_number_of_the_command() -> None:
    steps = """
    const connection = new Connection("v");
    const answer = (n, op) => connection.answered({ op, cmd: "outlet", ref: "a", n, why: "no" });
    answer(1, "refused");
    answer(2, "done");
    result = [connection.answers.get(1).op, connection.answers.get(2).op];
    for (let n = 3; n <= 500; n++) answer(n, "done");
    answer(0, "refused");
    result.push(connection.answers.size, connection.answers.has(500), connection.answers.has(300));"""
    assert run("../ui/parts/models.js", "Connection", steps) == ["refused", "done", 200, True, False]


@pytest.mark.parametrize(
    ("age", "period", "online", "gone"),
    [
        (9, 1, True, False),
        (11, 1, True, True),
        (11, 5, True, False),
        (16, 5, True, True),
        (99, 0, True, False),
        (0, 1, False, True),
    ],
)
def test_a_value_is_gone(age: float, period: float, online: bool, gone: bool) -> None:
    steps = f"result = isGone({{ age: {1000 * age}, period: {1000 * period} }}, {json.dumps(online)});"
    assert run("../ui/parts/parts.js", "isGone", steps) is gone


# -- scripts that run


def autonomy(steps: str) -> Any:
    names = "Since, handDriven, statusOf, whyNotStarted"
    return run("../ui/cards/autonomy-model.js", names, _PAGE + steps)


@pytest.mark.parametrize(
    "payload",
    [
        None,
        7,
        "x",
        [],
        {"running": "yes", "file": 3},
        {"running": True, "file": [], "dependencies": {"a": 1}, "config": [1]},
    ],
)
def test_a_status_may_be_anything(payload: Any) -> None:
    status = autonomy(f"result = statusOf({json.dumps(payload)});")
    assert status["running"] is (isinstance(payload, dict) and payload["running"] is True)
    assert (status["dependencies"], status["config"], status["error"]) == ([], [], "")


def test_a_status_of_a_robot() -> None:
    payload = {
        "running": True, "file": "follow", "pid": 7, "overridden": True, "error": None, "config": {"tag_id": 5},
        "dependencies": [{"file": "wheel-odometry", "pid": 8, "running": True}, {"file": 3, "running": 1}, "x"],
    }  # fmt: skip
    status = autonomy(f"result = statusOf({json.dumps(payload)});")
    assert status == {
        "running": True, "file": "follow", "pid": 7, "waits": True, "error": "", "config": [["tag_id", 5]],
        "dependencies": [{"file": "wheel-odometry", "running": True}, {"file": "?", "running": False}],
    }  # fmt: skip


def test_since_when_a_script_runs() -> None:
    steps = """
    const since = new Since();
    const see = (status, at) => { since.update(statusOf(status), at); return [since.at, since.isExact]; };
    const follow = { running: true, file: "follow", pid: 7 };
    result = [see(follow, 100), see({ ...follow, overridden: true }, 200), see({ running: false }, 300),
      see(follow, 400), see({ ...follow, pid: 8 }, 500)];"""
    assert autonomy(steps) == [[100, False], [100, False], [300, True], [400, True], [500, True]]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("", ""),
        ("page.connection.may = () => false", "Log in as driver to use this"),
        ('values[ref]["web/liveness"].online = false', "goob is silent"),
        ('values[ref]["web/liveness"].online = null', "goob has not been seen yet"),
        ('values[ref]["web/estop"] = { latched: true, by: "eve" }', "Stopped by eve"),
        ("values[ref].capabilities.value.autonomy.controls = false", "goob takes no such commands"),
        ('values[ref]["web/driver"] = { by: "bob", you: false, idle_s: null }', ""),
        (
            'values[ref]["web/driver"] = { by: "bob", you: false, idle_s: null }; drive.arbitrates = false',
            "bob is driving",
        ),
        (
            'values[ref]["web/driver"] = { by: "bob", you: true, idle_s: null }; drive.arbitrates = "yes"',
            "You are driving",
        ),
        ('values[ref]["web/driver"] = { by: "bob", you: false, idle_s: 0.1 }; drive.arbitrates = false', ""),
    ],
)
def test_why_no_script_can_be_started(change: str, why: str) -> None:
    steps = f"const {{ drive }} = values[ref].capabilities.value; {change}; result = whyNotStarted(page, ref);"
    assert autonomy(steps) == why
