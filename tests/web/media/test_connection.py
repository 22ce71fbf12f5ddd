"""The connection for pictures and sound is there while it is used, and a while longer."""

from __future__ import annotations

import asyncio

import pytest

from pebble.transports.memory import MemoryHub
from pebble.web.media.connection import MediaConnection
from tests.web.media.robots import broker_on, until

pytestmark = pytest.mark.anyio


async def test_it_is_open_from_the_first_use_until_a_while_after_the_last() -> None:
    connection = MediaConnection(broker_on(MemoryHub()), keep_s=0.2)
    broker = connection.broker
    assert not broker.connected
    async with connection.used():
        async with connection.used():
            assert broker.connected
        await asyncio.sleep(0.4)
        assert broker.connected
    async with connection.used():
        await asyncio.sleep(0.4)
        assert broker.connected, "it was used again before it was closed"
    await until(lambda: not broker.connected)
    async with connection.used():
        assert broker.connected
    await connection.close()
    assert not broker.connected


async def test_whatever_uses_it_at_once_finds_it_open() -> None:
    connection = MediaConnection(broker_on(MemoryHub()), keep_s=0.0)

    async def use() -> bool:
        async with connection.used():
            return connection.broker.connected

    for _ in range(5):
        assert await asyncio.gather(*(use() for _ in range(5))) == [True] * 5
        await asyncio.sleep(0)  # it may just be closing
    await connection.close()
