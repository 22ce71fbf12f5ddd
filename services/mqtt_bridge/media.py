"""Which media programs are wanted: a flag of the operators allows, a request of theirs starts and stops. Pure."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Final

from pebble.contract import AUDIO_CONTROL, MQTT_AUDIO, MQTT_VIDEO, VIDEO_CONTROL, Channel
from pebble.launched import Want
from pebble.payloads import MediaRequest


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """One medium: the channel that allows it, the one that asks for it and for which form, and what it takes."""

    flag: Channel
    request: Channel
    encodings: tuple[str, ...]
    programs: tuple[str, ...]


MEDIA: Final = (
    Row(MQTT_VIDEO, VIDEO_CONTROL, ("json", "pbvd", "pbvz", "h264"), ("camera_publisher", "video_stream")),
    Row(MQTT_AUDIO, AUDIO_CONTROL, ("pcm", "opus"), ("audio_publisher", "audio_receiver")),
)
_ROWS: Final = {channel.suffix: row for row in MEDIA for channel in (row.flag, row.request)}
_NO: Final = Want(on=False)


class Media:
    """What was said last about each medium of a robot that has ``programs``.

    ``running`` are those that a bridge before this one wanted: they count as requested, because the request is never
    kept and the operator does not know that the bridge was replaced. Whether a medium is allowed is not known until
    somebody has said it; until then nothing is said about what that alone decides.
    """

    def __init__(self, programs: Collection[str], running: Mapping[str, Want] | None = None) -> None:
        self._programs = programs
        self._allowed: dict[Row, bool] = {}
        self._requested = {row: _first(row, running or {}) for row in MEDIA}

    def allow(self, flag: Channel, allowed: bool) -> None:
        self._allowed[_ROWS[flag.suffix]] = allowed

    def request(self, channel: Channel, request: MediaRequest) -> None:
        """The last one counts, in all it says: an encoding it does not name, or one nobody knows, is as configured."""
        row = _ROWS[channel.suffix]
        encoding = request.encoding if request.encoding in row.encodings else None
        self._requested[row] = Want(request.enabled, encoding or "")

    def wants(self) -> dict[str, Want]:
        """By program; left out are those of which we cannot know yet."""
        found: dict[str, Want] = {}
        for row, want in self._requested.items():
            if not want.on or row in self._allowed:
                allowed = want.on and self._allowed[row]
                found |= dict.fromkeys(row.programs, want if allowed else _NO)
        return {name: want for name, want in found.items() if name in self._programs}


def _first(row: Row, running: Mapping[str, Want]) -> Want:
    return next((running[name] for name in row.programs if name in running), _NO)
