"""Every change of a chain is found at its line; a cut end by a mark."""

from collections.abc import Callable

import pytest

from pebble.contract.chain import BEGIN, Mark, line, parse, verify


def chain(length: int, before: Mark = Mark()) -> list[bytes]:  # noqa: B008 - a tuple
    lines = []
    for number in range(length):
        raw, before = line(before, {"t": 1.5, "what": "stop", "who": "ann", "number": number})
        lines.append(raw)
    return lines


def mark_of(raw: bytes) -> Mark:
    found = parse(raw)
    assert found is not None
    return found.mark


WHOLE = chain(20)
NEWEST = mark_of(WHOLE[-1])


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda raw: raw, ""),
        (lambda raw: raw[5:12], ""),  # a part
        (lambda raw: [*raw[:9], raw[9].replace(b"ann", b"bob"), *raw[10:]], "line 10 was changed"),
        (
            lambda raw: [*raw[:9], line(mark_of(raw[8]), {"what": "x"})[0], *raw[10:]],
            "line 11 was changed",
        ),
        (lambda raw: [*raw[:9], raw[9][:-5], *raw[10:]], "line 10 was changed: it cannot be read"),
        (lambda raw: [*raw[:9], *raw[10:]], "line 10 is missing"),
        (lambda raw: [*raw[:9], *raw[13:]], "lines 10 to 13 are missing"),
        (lambda raw: [*raw[:9], raw[3], *raw[9:]], "after line 9 a line with the number 4 was inserted"),
        (lambda raw: [*raw[:9], raw[10], raw[9], *raw[11:]], "line 10 is missing"),
        (lambda raw: [raw[0].replace(b"ann", b"bob"), *raw[1:]], "line 1 was changed"),
    ],
)
def test_the_first_bad_line_is_named(change: Callable[[list[bytes]], list[bytes]], problem: str) -> None:
    found = verify(change(list(WHOLE)))
    assert found.startswith(problem)
    assert bool(found) == bool(problem)


@pytest.mark.parametrize(
    ("lines", "problem"),
    [
        (WHOLE, ""),
        ([*WHOLE, *chain(3, NEWEST)], ""),
        (WHOLE[:-1], "line 20 is missing: the end was cut off"),
        (WHOLE[:-3], "lines 18 to 20 are missing: the end was cut off"),
        ([], "lines 1 to 20 are missing: the end was cut off"),
        ([*WHOLE[:15], *chain(9, mark_of(WHOLE[13]))[1:]], "line 16 was changed"),
        ([*WHOLE[:15], *(line(mark_of(WHOLE[14]), {"what": "x"})[0],)], "lines 17 to 20 are missing"),
    ],
)
def test_by_a_mark_a_cut_end_is_found(lines: list[bytes], problem: str) -> None:
    assert verify(lines, [NEWEST]).startswith(problem)


def test_an_end_that_was_written_anew_is_not_the_one_that_was_noted() -> None:
    forged = list(WHOLE[:15])
    mark = mark_of(forged[-1])
    for _ in range(10):
        raw, mark = line(mark, {"what": "nothing"})
        forged.append(raw)
    assert verify(forged) == ""
    assert verify(forged, [NEWEST]).startswith("line 20 is not the one that was noted elsewhere")


def test_the_first_line_of_a_file_is_verified_by_what_it_follows() -> None:
    begun, _ = line(NEWEST, {"what": "stop", "after": NEWEST.h})
    assert verify([*WHOLE, begun]) == ""
    assert verify([begun]) == ""
    assert verify([begun.replace(NEWEST.h.encode(), BEGIN.encode())]).startswith("line 21 was changed")


def test_what_is_no_line_is_none() -> None:
    for raw in (b"", b"[]", b"{", b'{"n":1,"h":"12"}', b'{"h":"' + b"0" * 32 + b'","n":1}', b"\xff"):
        assert parse(raw) is None
