"""The retained values at this moment, which a new file begins with. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from pebble.recordings.recorder.lane import CARRIED, Item
from pebble.transports.bounds import BoundedTable

_TOPICS, _BYTES = 10_000, 16 << 20


class RetainedValues:
    """By connection and topic."""

    def __init__(self) -> None:
        self._values = BoundedTable[Item](_TOPICS, _BYTES, lambda item: len(item.payload))

    def note(self, item: Item) -> None:
        """A message. Where the broker hides how it was published, a topic that is known to be retained stays so."""
        key = f"{item.source} {item.topic}"
        known = self._values.get(key)
        if item.retained and known is not None and not known.retained:
            return  # fetched by another connection, while a newer one had come
        if not item.retain and not (item.retain is None and known is not None):
            return
        if item.payload:
            self._values[key] = item._replace(retain=True)
        else:
            self._values.pop(key, None)

    def forget(self, source: str) -> None:
        """They are fetched anew."""
        for key in [key for key in self._values if key.startswith(f"{source} ")]:
            del self._values[key]

    def carried(self) -> Iterator[Item]:
        """What a new file begins with."""
        for item in list(self._values.values()):
            yield item._replace(retained=CARRIED)
