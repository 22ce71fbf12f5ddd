"""Names of topics."""

from common.settings import base


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
