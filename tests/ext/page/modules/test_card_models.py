"""What is behind the cards of a robot, without a browser: in Node.js."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from pebble.extensions.operator.client.forms import Setting
from tests.ext.boards import mcu_wire as wire
from tests.ext.page.in_node import Rows, Script, rows
from tests.ext.page.states import described

_STORED = """
const stored = new Map();
const getItem = (key) => stored.get(key) ?? null;
globalThis.localStorage = { getItem, setItem: (key, value) => stored.set(key, value) };
const texts = (map) => Object.fromEntries(map);
"""

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

BLACK = {"r": 0, "g": 0, "b": 0}
ORANGE = {"r": 1, "g": 0.533, "b": 0}
lights = Script({"ui/cards/lights-model.js": "Lights, lightsOf, supported, toggleFlash"}, _STORED + _PAGE, anew=True)
_ANSWER = """
const answer = (n, op) => { page.connection.answers.set(n, { op, n }); [...followers].forEach((fn) => fn()); };
const one = lightsOf(ref);
const lit = () => [one.mode, one.colour];
"""
#: What is asked of lights, and what is sent.
ASKED = {
    '{ colour: "#0000ff" }': {"r": 0, "g": 0, "b": 1},
    '{ mode: "flash", period: 99 }': ORANGE | {"period": 10},
    '{ mode: "flash", period: NaN }': ORANGE | {"period": 2},
    '{ mode: "off" }': BLACK,
    '{ colour: "red" }': ORANGE,
}
NO_FLASH = "goob has no lights that flash"
WHY_NO_FLASH = {
    "values[ref].capabilities.value.lights.controls = false": "goob takes no such commands",
    "values[ref].capabilities.value.lights.flash = false": NO_FLASH,
    "delete values[ref]": NO_FLASH,
}
# fmt: off
LIGHTS: Rows = {
    "a refusal does not undo what was asked after it": (f"""{_ANSWER}
        one.ask(page, {{ mode: "solid" }});
        one.sentAt = -Infinity;
        one.ask(page, {{ mode: "off" }});
        answer(1, "refused");
        result = [lit()[0]];
        answer(2, "done");
        result.push(lit()[0], followers.size);""", ["off", "off", 0]),
    **{f"what is asked of lights: {change}": (f"lightsOf(ref).ask(page, {change}); result = sent;", [expected])
        for change, expected in ASKED.items()},
    **{f"a flash ends in what was before: {before}": (f"""
        const one = lightsOf(ref);
        one.ask(page, {{ mode: "{before}" }});
        result = [toggleFlash(page, ref), one.mode, toggleFlash(page, ref), one.mode];""", ["", "flash", "", before])
        for before in ("solid", "off")},
    "lights that were refused are as before": (f"""{_ANSWER}
        one.ask(page, {{ mode: "solid", colour: "#0000ff" }});
        answer(1, "done");
        one.sentAt = -Infinity;
        result = [toggleFlash(page, ref), lit()];
        answer(2, "refused");
        result.push(lit(), followers.size);
        one.sentAt = -Infinity;
        page.commands.setLights = () => 0;
        one.ask(page, {{ mode: "off" }});
        result.push(lit());""", ["", ["flash", "#0000ff"], ["solid", "#0000ff"], 0, ["solid", "#0000ff"]]),
    "a flash of a silent robot can be switched off": ("""
        const one = lightsOf(ref);
        one.ask(page, { mode: "flash" });
        values[ref]["web/liveness"].online = false;
        result = [toggleFlash(page, ref), one.mode, toggleFlash(page, ref)];""", ["", "off", "goob is silent"]),
    **{f"why lights do not flash: {change}": (f"{change}; result = [toggleFlash(page, ref), sent];", [why, []])
        for change, why in WHY_NO_FLASH.items()},
}
# fmt: on

# -- sounds

sounds = Script({"ui/cards/sounds-model.js": "grouped, play, repeatLast"}, _STORED + _PAGE, anew=True)
FILES = ["horn.wav", "Bell.wav", "animals/Cat.wav", "animals/dog.wav", "animals/wild/cat.wav"]
WILD = ["animals/wild/", FILES[4:]]
#: What is searched, how many are shown at most, and the groups; and how many more there are.
GROUPS = [
    ("", 60, [["", FILES[:2]], ["animals/", FILES[2:4]], WILD], 0),
    ("CAT", 60, [["animals/", FILES[2:3]], WILD], 0),
    ("  wild   cat ", 60, [WILD], 0),
    ("", 2, [["", FILES[:2]]], 3),
]
# fmt: off
SOUNDS: Rows = {
    "what cannot be played is not repeated": ("""
        result = [play(page, ref, "x".repeat(1001), false), repeatLast(page, ref)];
        values[ref].capabilities.value.soundboard.controls = false;
        result.push(play(page, ref, "horn.wav", false), repeatLast(page, ref), sent);""",
        ["Its name is too long", "Play one sound first", *["goob takes no such commands"] * 2, []]),
    "the last sound is repeated as it was played": ("""
        result = [repeatLast(page, ref), play(page, ref, "a/horn.wav", true), repeatLast(page, ref),
          repeatLast(page, "pebble/robots/fred"), sent];""",
        ["Play one sound first", "", "", "Play one sound first", [["a/horn.wav", True]] * 2]),
    **{f"{most} clips with '{words}' are grouped by folder": (
        f"result = grouped({json.dumps(FILES)}, '{words}', {most});", {"folders": folders, "more": more})
        for words, most, folders, more in GROUPS},
}
# fmt: on

# -- forms of scripts

forms = Script(
    {"ui/cards/form-model.js": "filled, hint, remember, remembered, scripts"},
    _STORED,
)


def entry(key: str, kind: Any = "string", **more: Any) -> dict[str, Any]:
    return Setting(key=key, type=kind, **more).entry()


ALL = [
    entry("name", default="goob"),
    entry("power", "float", default=0.5, min=0.1, max=1.0),
    entry("search", "bool", default=True),
    entry("tag", "int", required=True),
]
GIVEN = {"name": "naïve café", "power": "0.25", "search": "false", "tag": "0", "other": "x"}
SENT = {"name": "naïve café", "power": 0.25, "search": False, "tag": 0}
HINTS = [
    (entry("a", "int", min=1, max=9, default=3), "A whole number from 1 to 9"),
    (entry("a", "float", min=0.5), "A number, at least 0.5"),
    (entry("a", "float", max=2, default=1.5), "A number, at most 2"),
    (entry("a"), ""),
]
NOT_STORED = '[[1,2,3],["goob","a",{"x":1}],["goob","a",[["x",1]]],null]'
# fmt: off
FORMS: Rows = {
    "a memory of something else is none": (f"""
        stored.set("pebble forms", {json.dumps(NOT_STORED)}); result = texts(remembered("goob", "a"));""", {}),
    "what was filled in is sent in the types of JSON": (f"""
        result = [{{ tag: "7" }}, {json.dumps(GIVEN)}].map(
          (texts) => filled({json.dumps(ALL)}, new Map(Object.entries(texts))));""", [{"tag": 7}, SENT]),
    "hints": (f"result = {json.dumps([one for one, _ in HINTS])}.map(hint);", [expected for _, expected in HINTS]),
    "forms are remembered by robot and script": ("""
        remember("goob", "a", new Map([["x", "1"]]));
        remember("goob", "b", new Map([["x", "2"]]));
        remember("fred", "a", new Map([["x", "3"]]));
        result = [texts(remembered("goob", "a")), texts(remembered("goob", "b")), texts(remembered("fred", "b"))];""",
        [{"x": "1"}, {"x": "2"}, {}]),
}
# fmt: on

# -- what may be asked, and scripts that run

SERVER, BROKER, DRIVER, MAINTAINER = (
    "No connection to the server",
    "The server cannot reach the broker",
    "Log in as driver to use this",
    "Log in as maintainer to use this",
)
may = Script(
    {
        "ui/cards/autonomy-model.js": "whyNotStarted",
        "ui/parts/why-not.js": "whyNot, whyNotEnd",
        "ui/parts/parts.js": "held, isGone",
    },
    _PAGE,
)
#: What ends something may be asked of a silent robot: why it, what a driver and what a maintainer does may not.
WHYS = {
    "": ["", "", MAINTAINER],
    "page.connection.may = () => false": [DRIVER, DRIVER, MAINTAINER],
    'values[ref]["web/liveness"].online = false': ["", "goob is silent", MAINTAINER],
    'values[""]["web/broker"].problem = "x"': ["", BROKER, MAINTAINER],
    'values[""]["web/broker"].connected = false': [BROKER] * 3,
    "page.connection.isOpen = false": [SERVER] * 3,
}
BOB = 'values[ref]["web/driver"] = { by: "bob", you: %s, idle_s: %s }'
WHY_NOT_STARTED = {
    'values[ref]["web/liveness"].online = null': "goob has not been seen yet",
    'values[ref]["web/estop"] = { latched: true, by: "eve" }': "Stopped by eve",
    "values[ref].capabilities.value.autonomy.controls = false": "goob takes no such commands",
    BOB % ("false", "null"): "",
    BOB % ("false", "null") + "; drive.arbitrates = false": "bob is driving",
    BOB % ("true", "null") + '; drive.arbitrates = "yes"': "You are driving",
    BOB % ("false", "0.1") + "; drive.arbitrates = false": "",
}
#: The age of a value and its usual period in seconds, and whether its robot is online and the value gone.
GONE = [
    (11, 1, True, True),
    (11, 5, True, False),
    (99, 0, True, False),
    (0, 1, False, True),
]
# fmt: off
MAY: Rows = {
    **{f"why no script can be started: {change}": (f"""
        const {{ drive }} = values[ref].capabilities.value; {change}; result = whyNotStarted(page, ref);""", why)
        for change, why in WHY_NOT_STARTED.items()},
    **{f"what may be asked: {change}": (
        f'{change}; result = [whyNotEnd(page), whyNot(page, ref), whyNot(page, ref, "", "system")];', whys)
        for change, whys in WHYS.items()},
    **{f"after {age} s of {period} s a value is gone: {gone}": (
        f"result = isGone({{ age: {1000 * age}, period: {1000 * period} }}, {json.dumps(online)});", gone)
        for age, period, online, gone in GONE},
    "of the keys only Space and Enter hold a button, each once": ("""
        let begun = 0; const { onKeyDown } = held(() => begun++, () => {}, true);
        for (const code of ["KeyW", "Space", "Enter"]) [false, true].forEach((repeat) => onKeyDown({ code, repeat }));
        result = begun;""", 2),
}
# fmt: on


# -- manifests of microcontrollers, what a robot offers, and outlets

cards = Script(
    {
        "core/stream.js": "refusal",
        "ui/cards/manifest.js": "range, step, unsendable",
        "ui/cards/outlets.js": "outletsOf, obstacle",
        "ui/parts/models.js": "Offers",
    }
)


def of(expression: str, *values: Any) -> str:
    """Steps: what ``expression`` makes of ``v``, the ``values``."""
    return f"const v = {json.dumps(values)}; result = {expression};"


PRIVATE = wire.M("m", (wire.I(1, "a", wire.IN, wire.KIND_COMMAND, (wire.F("x", wire.U8),), flags=wire.LOCAL_ONLY),))
#: Fields, and the least and the greatest value, and the step.
RANGES: list[tuple[dict[str, Any], Any, str]] = [
    *[({"type": f"u{bits}"}, [0, 2**bits - 1], "1") for bits in (8, 16, 32)],
    ({"type": "u8", "scale": 0.5}, [0, 127.5], "0.5"),
    ({"type": "i16", "scale": -0.1, "offset": 10}, [-3266.7, 3286.8], "any"),
    ({"type": "f32"}, None, "any"),
]
OFFERED = {"value": {"outlets": {"available": True, "outlets": [{"name": "o1", "controls": False}, {"name": "o2"}]}}}
#: Capabilities, metrics, and the outlets, and whether each can be switched.
OUTLETS: list[tuple[Any, list[str], dict[str, bool]]] = [
    (OFFERED, ["outlets/o1/status", "outlets/o9/status"], {"o1": False, "o2": True, "o9": False}),
    (None, ["outlets/o1/status", "outlets/o1/other", "outlets/x"], {"o1": True}),
]
NOT_TOPIC = "its name cannot be part of a topic"
#: Names of outlets, whether they can be switched, what they report, and why they cannot be switched on.
OBSTACLES: list[tuple[str, bool, dict[str, Any], str]] = [
    ("o1", True, {"bound": True, "reachable": True, "on": False}, ""),
    ("o1", True, {"reachable": False}, "outlet is unreachable"),
    ("o1", True, {"bound": False, "reachable": False}, "no device is bound to this outlet"),
    ("o1", False, {}, "this outlet cannot be switched from here: its robot lists no control"),
    ("a/b", True, {}, NOT_TOPIC),
    ("x" * 65, True, {}, NOT_TOPIC),
]
PAGE = "{ protocol: 'https:', hostname: 'lab.local' }"
#: Addresses of a robot's own stream, and why they are not shown in a page that came by https from lab.local.
STREAMS = {
    "https://goob.local:8443/stream": "",
    "http://localhost:8080": "",
    "http://goob.local": "This page came by https",
    "https://LAB.local:9": "This address is on the page's own host",
    **dict.fromkeys(
        ("javascript:parent.ran = 1", "https://me:secret@goob.local", "https://goob.local:0", "https://x/" + "y" * 500),
        "This address is not shown",
    ),
}
# fmt: off
CARDS: Rows = {
    "an interface that stays on the robot takes no commands": (
        of("unsendable(v[0].interfaces[0]).slice(0, 22)", described(PRIVATE)), "it takes commands from"),
    **{f"what takes commands has fields of known types: {kind}": (
        of("unsendable(v[0])", {"encoding": {"fields": [{"name": "x", "type": kind}]}}), why)
        for kind, why in {**dict.fromkeys(("bool", "f32", "u8"), ""), "f64": "x is of an unknown type"}.items()},
    **{f"outlets are those that are listed and those that report: {metrics}": (of("""Object.fromEntries(
        outletsOf(new Offers('pebble/robots/a', v[0], v[1])).map(({ name, controls }) => [name, controls]))""",
        capabilities, metrics), expected) for capabilities, metrics, expected in OUTLETS},
    **{f"what a field can hold: {field}": (of("[range(v[0]), step(v[0])]", field), [limits, step])
        for field, limits, step in RANGES},
    **{f"why {name[:8]} {controls} {report} cannot be switched": (
        of("obstacle(...v)", name, controls, report, True), why) for name, controls, report, why in OBSTACLES},
    "an outlet that reports a fault can be switched off":
        ("result = obstacle('o1', true, { bound: false }, false);", ""),
    **{f"why no stream is shown of {address[:40]}": (
        f"result = refusal({json.dumps(address)}, {PAGE}).slice(0, {len(why) or 99});", why)
        for address, why in STREAMS.items()},
}
# fmt: on


@rows((lights, LIGHTS), (sounds, SOUNDS), (forms, FORMS), (may, MAY), (cards, CARDS))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
