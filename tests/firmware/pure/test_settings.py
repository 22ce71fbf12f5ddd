"""The settings file, as people write it, and names of topics."""

import os

from common.settings import base, get, load

_FILE = "settings-of-a-test.json"
_JSON, _LACKS = "is no JSON", "lacks wifi.ssid"


def _why(written) -> str:
    """What is reported about a file with these bytes, or about none."""
    if written is not None:
        with open(_FILE, "wb") as file:  # noqa: PTH123 - boards have no pathlib
            file.write(written)
    try:
        return "ssid " + get(load(_FILE), "wifi", "ssid")
    except ValueError as error:
        return str(error)
    finally:
        if written is not None:
            os.remove(_FILE)  # noqa: PTH107


def test_what_is_wrong_with_a_file_is_named() -> None:
    for written, why in (
        (b'{"wifi": {"ssid": "Lab"}}', "ssid Lab"),
        (b'\xef\xbb\xbf{"wifi": {"ssid": "Lab"}}\r\n', "ssid Lab"),
        (None, _LACKS),
        (b"{}", _LACKS),
        (b'{"wifi": {}}', _LACKS),
        (b'{"wifi": {"ssid": null}}', _LACKS),
        (b"", _JSON),
        (b'{"wifi": {"ssid": "Lab"}', _JSON),
        (b'{"wifi": {"ssid": "Lab}}', _JSON),
        (b"{'wifi': {'ssid': 'Lab'}}", _JSON),
        (b'// mine\n{"wifi": {"ssid": "Lab"}}', _JSON),
        (b'\xff\xfe{\0"\0w\0"\0:\x001\0}\0', _JSON),
        (b"[]", _LACKS),
        (b'"Lab"', _JSON),
        (b"5", _JSON),
        (b'{"wifi": "Lab"}', _LACKS),
        (b'{"wifi": ["Lab"]}', _LACKS),
    ):
        found = _why(written)
        assert why in found, (written, found)


def test_the_base_of_all_topics() -> None:
    assert base("pebble", "robots", "benjr") == b"pebble/robots/benjr"


def test_names_that_would_be_other_topics() -> None:
    for name in ("", "a/b", "+", "a#", 'a"b', "a\\b", "a\nb", "a\x00"):
        for parts in ((name, "robots", "id"), ("pebble", name, "id"), ("pebble", "robots", name)):
            try:
                base(*parts)
            except ValueError:
                continue
            raise AssertionError(parts)
