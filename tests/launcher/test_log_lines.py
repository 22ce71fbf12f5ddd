from __future__ import annotations

import pytest

from pebble.launcher.log_lines import LINE_LIMIT, LevelReader, LineSplitter, cut


def test_lines_arrive_in_pieces() -> None:
    splitter = LineSplitter()
    assert splitter.feed(b"one\ntw") == ["one"]
    assert splitter.feed(b"o\r\n\n  three  \nfo") == ["two", "  three"]
    assert splitter.rest() == ["fo"]
    assert splitter.rest() == []


def test_a_character_cut_in_two_is_whole_again() -> None:
    splitter = LineSplitter()
    whole = "käse\n".encode()
    assert splitter.feed(whole[:2]) == []
    assert splitter.feed(whole[2:]) == ["käse"]


def test_bytes_that_are_no_text_are_replaced() -> None:
    assert LineSplitter().feed(b"a\xff\xfeb\n") == ["a\ufffd\ufffdb"]


def test_a_line_without_end_is_cut_and_its_rest_dropped() -> None:
    splitter = LineSplitter()
    said = [line for _ in range(100) for line in splitter.feed(b"x" * 1000)]
    assert said == ["x" * LINE_LIMIT]
    assert splitter.feed(b"xx\nnext\n") == ["next"]
    assert splitter.feed(b"y" * 2 * LINE_LIMIT + b"\nnext\n") == ["y" * LINE_LIMIT, "next"]


def test_exactly_the_limit_is_not_too_long() -> None:
    splitter = LineSplitter()
    assert splitter.feed(b"x" * LINE_LIMIT) == []
    assert splitter.feed(b"\nnext\n") == ["x" * LINE_LIMIT, "next"]


@pytest.mark.parametrize(
    ("line", "level", "text"),
    [
        ("12:00:00 [INFO] hello", "INFO", "hello"),
        ("12:00:00 [WARNING] hello", "WARNING", "hello"),
        ("12:00:00 [WARN] hello", "WARNING", "hello"),
        ("12:00:00,123 [ERROR] hello", "ERROR", "hello"),
        ("12:00:00 [CRITICAL] [x] y", "CRITICAL", "[x] y"),
        ("12:00:00 [DEBUG] ", "DEBUG", ""),
        ("12:00:00 [SHOUT] hello", "INFO", "12:00:00 [SHOUT] hello"),
        ("12:00 [ERROR] hello", "INFO", "12:00 [ERROR] hello"),
        ("ERROR hello", "INFO", "ERROR hello"),
    ],
)
def test_a_line_of_the_agreed_form_says_its_level(line: str, level: str, text: str) -> None:
    assert LevelReader().read(line) == (level, text)


def levels(*lines: str) -> list[str]:
    reader = LevelReader()
    return [reader.read(line)[0] for line in lines]


def test_a_traceback_has_the_level_of_the_line_it_belongs_to() -> None:
    assert (
        levels(
            "12:00:00 [WARNING] it broke",
            "Traceback (most recent call last):",
            '  File "x.py", line 1',
            "ValueError: no",
            "During handling of the above exception, another exception occurred:",
            "Traceback (most recent call last):",
            "KeyError: 1",
            "12:00:01 [INFO] goes on",
            "a print",
        )
        == ["WARNING"] * 7 + ["INFO"] * 2
    )


def test_a_traceback_of_its_own_is_an_error() -> None:
    assert levels("a print", "Traceback (most recent call last):", "  File", "ImportError: no") == [
        "INFO",
        *["ERROR"] * 3,
    ]


def test_indented_lines_continue_and_others_do_not() -> None:
    assert levels("12:00:00 [ERROR] two reasons:", "  one", "  two", "a print", "  of its own") == [
        *["ERROR"] * 3,
        *["INFO"] * 2,
    ]


def test_cut() -> None:
    assert cut("x" * 64, 64) == "x" * 64
    assert cut("x" * 65, 64) == "x" * 61 + "..."
