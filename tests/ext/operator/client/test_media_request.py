"""What the request for pictures bounds and keeps: the event loop may be late, and the broker away."""

from __future__ import annotations

import asyncio

import pytest

from pebble.contract import STATUS
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.media_request import shared
from pebble.extensions.operator.client.media_request.shared import SharedRequest
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message
from tests.ext.page.media.robots import REF, VIDEO, PictureRobot, broker_on, status_of, until

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


class Requested:
    """A robot that sends nothing by itself, and a request for its pictures that runs."""

    def __init__(self) -> None:
        self.robot = PictureRobot()
        self.robot.mute = True
        self.broker = broker_on(self.robot.hub)
        self.received: list[bytes] = []
        self.view = RobotView(REF)
        self.view.capabilities = {"video": VIDEO}
        self.request = SharedRequest(self.broker, REF, "video", self.received.append)

    def status(self, camera: str) -> None:
        self.view.receive(STATUS, Message(STATUS.topic(REF), status_of(camera)), 0.0, 0.0)

    async def step(self) -> None:
        await self.request.follow(self.view, "json")


async def test_it_is_withdrawn_once_there_is_a_broker_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared, "LINGER_S", 0.0)
    there, one = [True], Requested()
    monkeypatch.setattr(Broker, "connected", property(lambda _: there[0]))
    await one.broker.open()
    one.request.want(True)
    task = asyncio.create_task(one.request.run(one.step))
    await until(lambda: one.robot.requests)
    there[0] = False
    one.request.want(False)
    await asyncio.sleep(0.5)
    assert one.robot.encodings == ["json"]
    there[0] = True
    await until(lambda: one.robot.encodings == ["json", None])
    one.request.close()
    await task
    await one.broker.close()
    one.robot.close()


async def test_nothing_is_asked_of_a_robot_that_waits() -> None:
    one = Requested()
    one.status("held")
    await one.broker.open()
    one.request.want(True)
    for _ in range(3):
        await one.step()
    await one.request.request_keyframe("json")
    assert one.request.waits == "Pictures wait for driving"
    assert one.robot.published == []
    one.status("running")
    await one.step()
    await until(lambda: one.robot.encodings == ["json"])
    one.status("held")
    await one.step()
    await one.request.request_keyframe("json")
    one.request.close()
    await one.request.run(one.step)
    await until(lambda: one.robot.encodings == ["json", None])
    await one.broker.close()
    one.robot.close()
