"""What goob's sensors send is what its page plots, and what its odometry says is where its map shows it."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
from playwright.sync_api import Browser

from pebble.transports import Message, MqttSettings, create
from tests.web.console import Console, Wire, console
from tests.web.stage import Stage

pytestmark = pytest.mark.alone


class Sensors:
    """All that the operators' broker carried of some metrics of goob."""

    def __init__(self, broker_port: int) -> None:
        self.received: list[tuple[str, Any]] = []
        self._transport = create("mqtt", "sensors", MqttSettings(host="127.0.0.1", port=broker_port))
        self._transport.open()
        for metric in ("charging-level", "sensors/imu", "wheel-odometry"):
            self._transport.subscribe(f"pebble/robots/goob/outgoing/{metric}", self._receive)

    def all(self, metric: str) -> list[Any]:
        return [value["value"] for topic, value in list(self.received) if topic.endswith(f"outgoing/{metric}")]

    def close(self) -> None:
        self._transport.close()

    def _receive(self, message: Message) -> None:
        self.received.append((message.topic, msgspec.json.decode(message.payload)))


@pytest.fixture(scope="module")
def goob_stage() -> Iterator[Stage]:
    with Stage("goob") as running:
        yield running


@pytest.fixture(scope="module")
def sensors(goob_stage: Stage) -> Iterator[Sensors]:
    running = Sensors(goob_stage.broker_port)
    yield running
    running.close()


@pytest.fixture(scope="module")
def wire(goob_stage: Stage) -> Iterator[Wire]:
    running = Wire(goob_stage)
    yield running
    running.close()


@pytest.fixture(scope="module")
def goob(browser: Browser, goob_stage: Stage, sensors: Sensors) -> Iterator[Console]:
    with console(browser, goob_stage, "goob") as opened:
        yield opened


#: Every row that the page remembers of a metric.
_ROWS = """async ([kind, metric]) => {
  const { recorderOf } = await import(`/static/${pebble.connection.version}/ui/recorder.js`);
  return recorderOf(pebble, pebble.route.ref).all.get(`${kind} ${metric}`)?.rows ?? [];
}"""


def rows(goob: Console, metric: str, kind: str = "numbers") -> list[Any]:
    found: list[Any] = goob.page.evaluate(_ROWS, [kind, metric])
    return found


@pytest.mark.parametrize(
    ("metric", "field", "count"), [("charging-level", ("value",), 1), ("sensors/imu", ("accel_norm_g",), 10)]
)
def test_a_plot_has_the_values_that_the_broker_carried(
    goob: Console, sensors: Sensors, metric: str, field: tuple[str, ...], count: int
) -> None:
    goob.test({"charging-level": "plot-battery", "sensors/imu": "plot-acceleration"}[metric]).wait_for()
    assert goob.tab.until(lambda: len(rows(goob, metric)) >= count, 20)
    shown = [row[field[-1]] for row in rows(goob, metric)]
    carried = [value if metric == "charging-level" else value[field[-1]] for value in sensors.all(metric)]
    assert set(shown) <= set(carried)
    assert goob.tab.until(
        lambda: f"{carried[-1]:.2f}" in goob.test("plot-battery").inner_text() or metric != "charging-level"
    )


def test_what_was_sent_before_a_reload_is_there_after_it(goob: Console) -> None:
    assert goob.tab.until(lambda: len(rows(goob, "sensors/imu")) >= 15, 10)
    before = rows(goob, "sensors/imu")
    goob.page.reload()
    assert goob.tab.until("!!window.pebble?.connection.you")
    assert goob.tab.until(lambda: any(row in before for row in rows(goob, "sensors/imu")[:1]), 10)
    times = goob.page.evaluate(_ROWS.replace("rows ?? []", "times"), ["numbers", "sensors/imu"])
    assert times == sorted(set(times))


def test_the_map_follows_goob_while_it_drives(goob: Console, goob_stage: Stage, wire: Wire, sensors: Sensors) -> None:
    """Its hall sensors are not published: odometry is where its simulated MCU says that it is."""

    def publish() -> float:
        pose = goob_stage.robots["goob"].mcu_reports[-1].board.pose
        value = {"x_mm": pose.x_mm, "y_mm": pose.y_mm, "heading_rad": pose.heading_rad}
        wire.publish("goob/outgoing/wheel-odometry", {"value": value, "unit": "mm", "timestamp": time.time()})
        goob.page.wait_for_timeout(50)
        return math.hypot(pose.x_mm - start[0], pose.y_mm - start[1])

    pose = goob_stage.robots["goob"].mcu_reports[-1].board.pose
    start = pose.x_mm, pose.y_mm
    assert goob.tab.until(lambda: publish() >= 0 and goob.test("map").count() == 1, 10)
    assert goob.tab.until(lambda: publish() >= 0 and bool(rows(goob, "wheel-odometry", "poses")))
    words = goob.test("map-pose").inner_text()
    goob.take()
    assert goob.drive()
    assert goob.tab.until(lambda: publish() > 100, 8)
    goob.let_go()
    assert goob.rests()

    def agree() -> bool:
        publish()
        last, text = sensors.all("wheel-odometry")[-1], goob.test("map-pose").inner_text()
        return text != words and text.startswith(f"x {last['x_mm'] / 1000:.2f} m")

    assert goob.tab.until(agree, 5)
    xs = {round(pose["x"], 3) for pose in rows(goob, "wheel-odometry", "poses")}
    assert len(xs) > 1
    assert xs <= {round(one["x_mm"] / 1000, 3) for one in sensors.all("wheel-odometry")}
    assert goob.tab.complaints() == []
