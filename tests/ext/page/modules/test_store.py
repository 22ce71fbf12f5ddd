"""The page's store: values, their ages and periods, subscriptions, and the server's clock; in Node.js."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tests.ext.page.in_node import Rows, Script, rows

_SETUP = """
let now = 1000;
const waiting = [];
const store = new Store(() => now, (fn) => waiting.push(fn));
const frame = () => waiting.splice(0).forEach((fn) => fn());
const calls = [];
"""


run = Script({"core/store.js": "Store"}, _SETUP)


# fmt: off
RUN: Rows = {
    "a value ages from its age at the server": (
        'store.set("a", "m", 7, 400); now += 100; const v = store.get("a", "m"); result = [v.value, v.age];',
        [7, 500]),
    "subscribers of a metric are called once for many changes": ("""
        store.subscribe("a", "m", () => calls.push("m"));
        store.subscribe("b", "m", () => calls.push("b"));
        store.set("a", "m", 1); store.set("a", "m", 2); store.set("a", "n", 1); frame();
        const first = [...calls]; store.set("a", "m", 3); frame();
        result = [first, calls];""", [["m"], ["m", "m"]]),
    "a metric of any component is noticed, also that it goes": ("""
        store.subscribe(null, "m", () => calls.push(store.refs().join()));
        store.set("a", "m", 1); store.set("b", "m", 1); frame();
        store.set("a", "n", 1); frame();
        store.drop("b", "m"); frame();
        store.remove("a"); frame();
        result = calls;""", ["a,b", "a,b", "b"]),
    "a subscriber that fails keeps no other from being called": ("""
        process.on("uncaughtException", (error) => calls.push(error.message));
        store.subscribe("a", "m", () => { throw new Error("bad"); });
        store.subscribe("b", "m", () => calls.push("b"));
        store.set("a", "m", 1); store.set("b", "m", 2); frame();
        await new Promise((done) => setTimeout(done, 1));
        result = calls;""", ["b", "bad"]),
    "a subscription ends": ("""
        const end = store.subscribe("a", "m", () => calls.push("m"));
        end(); store.set("a", "m", 1); frame(); result = calls;""", []),
    "components and new metrics are noticed": ("""
        store.subscribe(null, null, () => calls.push(store.refs().join()));
        store.subscribe("a", null, () => calls.push(store.metrics("a").join(" ")));
        store.set("", "web/broker", {}); store.set("a", "m", 1); frame();
        store.set("a", "m", 2); frame();
        store.set("a", "n", 2); frame();
        store.remove("a"); frame();
        result = calls;""", ["a", "m", "m n", "", ""]),
    "the period is the usual time between updates": ("""
        const periods = [];
        for (const wait of [0, 200, 210, 190, 5000, 200]) {
          now += wait; store.set("a", "m", 1); periods.push(store.get("a", "m").period);
        }
        result = periods;""", [0, 0, 0, 200, 210, 200]),
    "late messages do not set the clock back": ("""
        store.sync(50_000, 20); const prompt = store.now();
        now += 500; store.sync(50_500 - 300, 20); const late = store.now();
        result = [prompt, late];""", [50_010, 50_510]),
    "a clock that was set is followed": ("""
        store.sync(50_000, 0);
        for (let i = 0; i < 60; i++) { now += 500; store.sync(20_000 + now, 0); }
        result = store.now() - now;""", 20_000),
}
# fmt: on


@rows((run, RUN))
def test_each(found: Callable[[], Any], expected: Any) -> None:
    assert found() == expected
