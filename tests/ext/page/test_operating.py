"""What a page needs to operate whole robots, at a real server and broker: logs, flags, actions, and its own name."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Coroutine
from typing import Any, cast

import httpx
import pytest

from pebble.errors import TransportError
from pebble.extensions.operator.client.broker import Broker as BrokerOfPages
from pebble.extensions.page import open_components
from pebble.extensions.page.robots import Interest, Robots
from pebble.transports import Message, MqttSettings, QoS, create
from tests.ext.page.served import Page
from tests.support import Broker, until


def lines(page: Page) -> list[str]:
    """Return the log lines that a page has received."""
    return [line["message"] for message in list(page.logs) for line in message["lines"]]


def publish(broker: Broker, topic: str, payload: bytes, *, retain: bool = False) -> None:
    with create("mqtt", "somewhere", MqttSettings(host="127.0.0.1", port=broker.port)) as transport:
        transport.publish(topic, payload, qos=QoS.DELIVERED, retain=retain)
        assert until(lambda: transport.outgoing.waiting == 0)


# -- logs


def test_a_page_that_reads_logs_receives_those_from_before_and_those_that_come(served, page, robot) -> None:
    def logged(text: str) -> bool:
        """Publish until the server receives it: it subscribes a moment after the page has opened the robot."""
        robot.publish("logs", {"message": text})
        robot.publish("status", {"value": text})
        return page.value(robot.base, "status", "value") == text

    page.send("watch", ref=robot.base)
    assert until(lambda: logged("first") and served.app.state.server.robots.logs[robot.base].after(0))
    assert page.logs == []  # it has not asked
    page.send("read-logs", ref=robot.base, on=True)
    assert until(lambda: lines(page))
    robot.publish("logs", {"message": "second"})
    assert until(lambda: lines(page)[-1] == "second")
    page.send("read-logs", ref=robot.base, on=False)
    assert until(lambda: logged("unread"))
    assert lines(page)[-1] == "second"
    seen = len(lines(page))
    page.send("read-logs", ref=robot.base, on=True, origin=page.logs[0]["origin"], after=seen)
    assert until(lambda: lines(page)[-1] == "unread")
    assert lines(page)[:seen].count("unread") == 0


# -- flags


def test_flags_are_those_of_the_broker(page, robot, broker) -> None:
    flags = lambda: page.value(robot.base, "web/flags")
    page.send("watch", ref=robot.base)
    assert until(flags)
    page.send("flag", ref=robot.base, name="mqtt-video", on=True)
    assert until(lambda: flags() == {"remote_mirror": None, "mqtt_audio": None, "mqtt_video": True})
    publish(broker, f"{robot.base}/incoming/flags/mqtt-audio", b'{"enabled": false}', retain=True)
    assert until(lambda: flags()["mqtt_audio"] is False)
    publish(broker, f"{robot.base}/incoming/flags/mqtt-video", b'"odd"')
    publish(broker, f"{robot.base}/incoming/flags/mqtt-audio", b"", retain=True)
    assert until(lambda: flags() == {"remote_mirror": None, "mqtt_audio": None, "mqtt_video": True})


# -- opened and closed


class Opened:
    """A robot whose page is opened and closed, with what is received; its broker unsubscribes when the test lets it."""

    base, connected = "pebble/robots/rig", True

    def __init__(self) -> None:
        self.filters: set[str] = set()
        self.refuses = ""  # a filter
        self.may_unsubscribe, self.loop = asyncio.Event(), asyncio.get_running_loop()
        self.robots, self.tasks = Robots(), list[asyncio.Future[None]]()
        spawn = lambda work: self.tasks.append(asyncio.ensure_future(work))
        self.components = open_components.OpenComponents(cast(BrokerOfPages, self), self.robots, spawn)

    def on_state(self, watcher: Callable[[], None]) -> None:
        pass

    async def subscribe(self, filter_: str, _handler: object, **_options: object) -> str:
        if filter_ == self.refuses:
            raise TransportError("no")
        self.filters.add(filter_)
        return filter_

    async def unsubscribe(self, filter_: str) -> None:
        await self.may_unsubscribe.wait()
        self.filters.discard(filter_)

    async def open(self) -> None:
        self.components.open(self.base)
        await asyncio.gather(*self.tasks)

    async def close(self) -> None:
        """Returns when it has begun to receive nothing more: the broker is about to end the first subscription."""
        self.components.close(self.base)
        while len(self.tasks) == 1:
            await asyncio.sleep(0)
        await asyncio.sleep(0)


async def opened_while_it_is_being_closed() -> None:
    rig = Opened()
    await rig.open()
    everything = set(rig.filters)
    await rig.close()
    rig.components.open(rig.base)
    rig.may_unsubscribe.set()
    await asyncio.gather(*rig.tasks)
    assert rig.filters == everything
    assert rig.base in rig.robots.logs


async def no_component_leaves_nothing() -> None:
    rig, other = Opened(), Interest(lambda: None)
    rig.may_unsubscribe.set()
    rig.robots.join(other)
    rig.components.open(rig.base)
    rig.robots.set_server_metric(rig.base, "web/picture-from", {"source": ""})
    await asyncio.gather(*rig.tasks)
    assert rig.robots.value(rig.base, "web/flags") is not None
    await rig.close()
    await asyncio.gather(*rig.tasks)
    assert (rig.filters, rig.robots.logs, rig.components.known, other.gone) == (set(), {}, set(), {rig.base})
    assert [rig.robots.value(rig.base, f"web/{metric}") for metric in ("flags", "picture-from")] == [None, None]


async def capabilities_pass_no_channel_off_as_another() -> None:
    rig = Opened()
    telemetry = {"imu_topic": f"{rig.base}/outgoing/front-camera", "touch_topic": f"{rig.base}/outgoing/renamed"}
    value = {"telemetry": telemetry, "video": {"flag_topic": f"{rig.base}/incoming/estop"}}
    payload = json.dumps({"schema": "pebble-capabilities/v1", "t": 1, "value": value}).encode()
    rig.robots.receive(Message(f"{rig.base}/outgoing/capabilities", payload), 0.0)
    await rig.open()
    assert {f"{rig.base}/outgoing/renamed", f"{rig.base}/incoming/flags/mqtt-video"} <= rig.filters
    assert not {f"{rig.base}/outgoing/front-camera", f"{rig.base}/incoming/estop"} & rig.filters


async def a_topic_that_is_refused_holds_back_no_other() -> None:
    rig = Opened()
    rig.refuses = f"{rig.base}/outgoing/sensors/imu"
    rig.components.open(rig.base)
    for _ in range(100):
        await asyncio.sleep(0)
    assert {f"{rig.base}/outgoing/logs", f"{rig.base}/incoming/flags/mqtt-video"} <= rig.filters
    rig.refuses = ""
    await asyncio.gather(*rig.tasks)
    assert f"{rig.base}/outgoing/sensors/imu" in rig.filters


STORIES = (
    opened_while_it_is_being_closed,
    no_component_leaves_nothing,
    capabilities_pass_no_channel_off_as_another,
    a_topic_that_is_refused_holds_back_no_other,
)


@pytest.mark.parametrize("story", STORIES)
def test_components_that_are_opened_and_closed(
    monkeypatch: pytest.MonkeyPatch, story: Callable[[], Coroutine[Any, Any, None]]
) -> None:
    for name in ("KEEP_S", "STEP_S"):
        monkeypatch.setattr(open_components, name, 0)
    asyncio.run(story())


# -- names


def test_without_a_login_a_pages_name_counts_also_for_a_stop_by_request(served, robot) -> None:
    with Page(served, name="Alice \u202e", device="phone") as alice, Page(served) as other:
        assert (alice.welcome["user"], other.welcome["user"]) == ("Alice ?", "local")
        assert alice.knows(robot.base)
        alice.send("estop", ref=robot.base, stop="00000000000000ff", why="test")
        stop = {"op": "estop", "ref": robot.base, "stop": "00112233445566aa"}
        answer = httpx.post(f"{served.origin}/api/estop?name=Alice", json=stop, headers={"origin": served.origin})
        assert answer.status_code == 202
    expected = {("stop", "Alice ?", "phone"), ("stop", "Alice", "")}
    audit = served.app.state.audit
    noted = lambda: {(one.what, one.user, one.device) for one in audit.read(20) if one.ref == robot.base}
    assert until(lambda: expected <= noted()), noted()
