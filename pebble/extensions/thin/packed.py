"""Several streams in one message, by their metrics below ``outgoing/``: JSON, or deflated JSON. Pure.

The first byte of deflated JSON is the number of its dictionary, 1 to 31; JSON begins with a brace.
"""

import zlib
from collections.abc import Mapping

import msgspec

from pebble.errors import PayloadError

MOST_BYTES = 64 * 1024  # of the JSON: a bomb is inflated no further
LAST_DICT = 31
HEARD_S = 5.0  # so long an expander counts as there; it says every 2 s that it is

_Streams = dict[str, msgspec.Raw]


def joined(streams: Mapping[str, bytes]) -> bytes:
    """Return streams, each a JSON value, as one JSON object."""
    return msgspec.json.encode({metric: msgspec.Raw(payload) for metric, payload in streams.items()})


def packed(text: bytes, dict_id: int, dictionary: bytes) -> bytes:
    """Return ``text`` as it is sent: deflated with a dictionary, or unchanged without one."""
    if not dictionary:
        return text
    deflater = zlib.compressobj(9, zlib.DEFLATED, -15, 9, zlib.Z_DEFAULT_STRATEGY, dictionary)
    return bytes((dict_id,)) + deflater.compress(text) + deflater.flush()


def unpacked(raw: bytes, dictionaries: Mapping[int, bytes]) -> dict[str, bytes]:
    """Return the streams in a message. Raises PayloadError for what cannot be read."""
    if raw and raw[0] <= LAST_DICT:
        if raw[0] not in dictionaries:
            raise PayloadError(f"its dictionary {raw[0]} is not known")
        raw = _inflated(raw[1:], dictionaries[raw[0]])
    try:
        streams = msgspec.json.decode(raw, type=_Streams)
    except (msgspec.DecodeError, RecursionError) as error:
        raise PayloadError(f"not a JSON object of streams: {error}") from None
    return {metric: bytes(payload) for metric, payload in streams.items()}


def _inflated(raw: bytes, dictionary: bytes) -> bytes:
    inflater = zlib.decompressobj(-15, zdict=dictionary)
    try:
        text = inflater.decompress(raw, MOST_BYTES)
    except zlib.error as error:
        raise PayloadError(f"not deflated: {error}") from None
    if not inflater.eof:
        raise PayloadError(f"more than {MOST_BYTES} bytes, or not all of them")
    return text
