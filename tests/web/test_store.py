"""The page's store: values, their ages and periods, subscriptions, and the server's clock; in Node.js."""

from __future__ import annotations

from typing import Any

from tests.web.in_node import evaluate

_SETUP = """
let now = 1000;
const waiting = [];
const store = new Store(() => now, (fn) => waiting.push(fn));
const frame = () => waiting.splice(0).forEach((fn) => fn());
const calls = [];
"""


def run(steps: str) -> Any:
    """The value of ``result`` after ``steps``, with ``store``, ``now``, ``frame`` and ``calls``."""
    return evaluate({"core/store.js": "Store"}, _SETUP + steps)


def test_a_value_ages_from_its_age_at_the_server() -> None:
    assert run(
        'store.set("a", "m", 7, 400); now += 100; const v = store.get("a", "m"); result = [v.value, v.age];'
    ) == [
        7,
        500,
    ]


def test_subscribers_of_a_metric_are_called_once_for_many_changes() -> None:
    steps = """
    store.subscribe("a", "m", () => calls.push("m"));
    store.subscribe("b", "m", () => calls.push("b"));
    store.set("a", "m", 1); store.set("a", "m", 2); store.set("a", "n", 1); frame();
    const first = [...calls]; store.set("a", "m", 3); frame();
    result = [first, calls];"""
    assert run(steps) == [["m"], ["m", "m"]]


def test_a_subscriber_that_fails_keeps_no_other_from_being_called() -> None:
    steps = """process.on("uncaughtException", (error) => calls.push(error.message));
    store.subscribe("a", "m", () => { throw new Error("bad"); });
    store.subscribe("b", "m", () => calls.push("b"));
    store.set("a", "m", 1); store.set("b", "m", 2); frame();
    await new Promise((done) => setTimeout(done, 1));
    result = calls;"""
    assert run(steps) == ["b", "bad"]


def test_a_subscription_ends() -> None:
    steps = """
    const end = store.subscribe("a", "m", () => calls.push("m"));
    end(); store.set("a", "m", 1); frame(); result = calls;"""
    assert run(steps) == []


def test_components_and_new_metrics_are_noticed() -> None:
    steps = """
    store.subscribe(null, null, () => calls.push(store.refs().join()));
    store.subscribe("a", null, () => calls.push(store.metrics("a").join(" ")));
    store.set("", "web/broker", {}); store.set("a", "m", 1); frame();
    store.set("a", "m", 2); frame();
    store.set("a", "n", 2); frame();
    store.remove("a"); frame();
    result = calls;"""
    assert run(steps) == ["a", "m", "m n", "", ""]


def test_the_period_is_the_usual_time_between_updates() -> None:
    steps = """
    const periods = [];
    for (const wait of [0, 200, 210, 190, 5000, 200]) {
      now += wait; store.set("a", "m", 1); periods.push(store.get("a", "m").period);
    }
    result = periods;"""
    assert run(steps) == [0, 0, 0, 200, 210, 200]


def test_late_messages_do_not_set_the_clock_back() -> None:
    steps = """
    store.sync(50_000, 20); const prompt = store.now();
    now += 500; store.sync(50_500 - 300, 20); const late = store.now();
    result = [prompt, late];"""
    assert run(steps) == [50_010, 50_510]


def test_a_clock_that_was_set_is_followed() -> None:
    steps = """
    store.sync(50_000, 0);
    for (let i = 0; i < 60; i++) { now += 500; store.sync(20_000 + now, 0); }
    result = store.now() - now;"""
    assert run(steps) == 20_000
