"""The control comparison: what a slice counts."""

from collections.abc import Callable

from pebble.extensions.lab.bench.control_ends import (
    REPLIES,
    Connection,
    Handler,
    Sender,
    Slice,
    SliceSpec,
    echo,
)


class Loop:
    """A connection to an echo in this process; ``spoil`` changes the replies."""

    def __init__(self, spoil: Callable[[bytes], list[bytes]] = lambda payload: [payload]) -> None:
        self._handlers: dict[str, Handler] = {}
        self._spoil = spoil
        self.sizes: list[int] = []
        self.connection = Connection(self._handlers.__setitem__, self.publish, lambda: None)

    def publish(self, topic: str, payload: bytes) -> None:
        self.sizes.append(len(payload))
        for one in self._spoil(payload) if topic == REPLIES else [payload]:
            self._handlers[topic](one)


def exchanged(loop: Loop, spec: SliceSpec) -> Slice:
    echo(loop.connection)
    sender = Sender(loop.connection)
    assert sender.warm_up(2, 5.0)
    done = sender.run(spec)
    assert all(one.sent_ns <= one.echoed_ns <= one.received_ns for one in done.exchanges)
    return done


def test_a_slice_counts_what_it_sends_after_the_first_tenth_of_a_second() -> None:
    loop = Loop()
    done = exchanged(loop, SliceSpec(size=64, rate=500, seconds=0.1))
    assert (done.sent, len(done.exchanges)) == (50, 50)
    assert len(loop.sizes) == 2 * (2 + 50 + 50)
    assert set(loop.sizes[4:]) == {64}


def test_what_comes_twice_counts_once_and_what_does_not_come_is_lost() -> None:
    def spoil(payload: bytes) -> list[bytes]:
        number = int.from_bytes(payload[:8], "little")
        return [payload, payload] if number < 10 or number % 2 else []

    done = exchanged(Loop(spoil), SliceSpec(size=40, rate=1000, seconds=0.05))
    assert (done.sent, len(done.exchanges)) == (50, 25)
