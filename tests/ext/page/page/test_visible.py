"""What is not seen in a text of a robot, or steers the text around it, is shown by its code: as in a terminal."""

from __future__ import annotations

import sys
import unicodedata
from functools import cache

import pytest

from pebble.config.visible import shown
from tests.ext.page.in_node import evaluate
from tests.support import some

#: Texts, and how they are shown.
TEXTS = {
    "goob": "goob",
    "go\u202eob": "go\\u202eob",
    "\u2066goob": "\\u2066goob",
    "goob\u200b": "goob\\u200b",
    "go\u00adob": "go\\u00adob",
    "goob\ufe0f": "goob\\ufe0f",
    "go\u200dob": "go\\u200dob",
    "\u200d\u200d": "\\u200d\\u200d",
    "\u0646\u200c\u0645": "\u0646\u200c\u0645",  # a Persian word
    "\u0646\u200c": "\u0646\\u200c",
    "\u00a0\u200d\u00e9": "\u00a0\\u200d\u00e9",
    "\U0001f469\u200d\U0001f680 \u2764\ufe0f": "\U0001f469\u200d\U0001f680 \u2764\ufe0f",
    "a\U000e0041b": "a\\U000e0041b",
    "\U000e0041\ufe0fb": "\\U000e0041\\ufe0fb",
    "\u2800\u3164\u115f": "\\u2800\\u3164\\u115f",
    "a\tb\nc\rd\x1b[31m\x7f\x00": "a\tb\nc\\u000dd\\u001b[31m\\u007f\\u0000",
    "a\u2028b\u2029c\u00a0d\u3000e": "a\\u2028b\\u2029c\u00a0d\u3000e",
    "\\u202e": "\\u202e",
}


def in_page(texts: list[str]) -> list[str]:
    result: list[str] = evaluate({"core/json.js": "visible"}, "result = given.map(visible);", texts)
    return result


def test_texts_are_shown_as_they_are_in_a_terminal() -> None:
    assert [shown(one) for one in TEXTS] == list(TEXTS.values())
    assert in_page(list(TEXTS)) == list(TEXTS.values())


@cache
def characters() -> list[str]:
    return [chr(code) for code in range(sys.maxunicode + 1) if unicodedata.category(chr(code)) not in ("Cn", "Co")]


@pytest.mark.parametrize(("around", "together"), [("a{}b", 100), ("\u00e9{}\u00e9", 100), ("{}", 1), ("\u00e9{}", 1)])
def test_the_rule_is_the_same_for_every_character(around: str, together: int) -> None:
    """Those with a letter on each side are many in one text: no character sees further than that."""
    each = [around.format(one) for one in some(characters(), 1 if together > 1 else 7)]
    texts = ["".join(each[first : first + together]) for first in range(0, len(each), together)]
    assert [pair for pair in zip(texts, in_page(texts), strict=True) if pair[1] != shown(pair[0])] == []
