"""Client ids: of what brokers take, different for every connection, or exactly what a config says."""

from __future__ import annotations

import re

import pytest

from pebble.transports.mqtt.client_ids import unique


@pytest.mark.parametrize(
    ("name", "begins"),
    [
        ("pebble/robots/goob/remote_bridge", "pebble_robots_goob_remote_bridge-"),
        ("pebble-tool-7", "pebble-tool-7-"),
        ("a.b", "a_b-2e7336-"),
        ("a b", "a_b-c8687a-"),
        ("a_b", "a_b-"),
        ("pebble/robots/größe", "pebble_robots_gr__e-9ce5d0-"),
        ("日本", "__-cf2abf-"),
        ('a>b*c$#+\\"', "a_b_c_____"),
        ("\ud800", "_-"),
        ("", "-"),
    ],
)
def test_an_id_has_letters_digits_and_two_signs(name: str, begins: str) -> None:
    first, second = unique(name), unique(name)
    assert re.fullmatch(r"[A-Za-z0-9_-]*-[0-9a-f]{16}", first)
    assert first.startswith(begins)
    assert first[:-16] == second[:-16]
    assert first != second
