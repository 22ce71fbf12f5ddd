"""Containers of what other programs send: bounded in number and in bytes."""

from __future__ import annotations

from pebble.transports.bounds import BoundedQueue, BoundedTable


class TestQueue:
    def test_drops_as_many_as_a_large_one_needs(self) -> None:
        queue: BoundedQueue[str] = BoundedQueue(10, 100)
        for item in "abc":
            queue.append(item, 30)
        assert queue.append("large", 70) == ["a", "b"]
        assert queue.append("larger", 1000) == ["c", "large"]
        assert queue.append("small", 1) == ["larger"]
        assert len(queue) == 1

    def test_what_was_taken_or_cleared_takes_no_room(self) -> None:
        queue: BoundedQueue[str] = BoundedQueue(10, 100)
        queue.append("a", 100)
        queue.popleft()
        assert queue.append("b", 100) == []
        queue.clear()
        assert queue.append("c", 100) == []


class TestTable:
    def made(self, topics: int = 10, size: int = 100) -> BoundedTable[bytes]:
        return BoundedTable(topics, size, len)

    def test_forgets_the_oldest_beyond_its_number(self) -> None:
        table = self.made(topics=2)
        for topic in ("a", "b", "a", "c"):
            table[topic] = b"1"
        assert dict(table) == {"a": b"1", "c": b"1"}

    def test_topics_count(self) -> None:
        table = self.made()
        table["a" * 60] = b""
        table["b" * 60] = b""
        assert len(table) == 1

    def test_one_that_is_too_large_leaves_the_others(self) -> None:
        table = self.made()
        table["a"] = table["b"] = b"1"
        table["a"] = bytes(100)
        assert dict(table) == {"b": b"1"}

    def test_what_was_removed_makes_room(self) -> None:
        table = self.made()
        table["a"] = bytes(99)
        assert not table.put_if_room("b", b"")
        assert dict(table) == {"a": bytes(99)}
        del table["a"]
        assert table.put_if_room("b", bytes(99))
        table.clear()
        assert table.put_if_room("c", bytes(99))
