"""Drive commands: what moves a robot, and what never does."""

from common.payload import wanted


def test_bare_and_wrapped() -> None:
    assert wanted(b'{"x": 0.5, "z": -0.25, "y": 1}') == (0.5, -0.25, 1.0)
    assert wanted(b'{"value": {"x": 0.5, "z": -0.25}, "z": 1}') == (0.5, -0.25, 0.0)
    assert wanted(b'{"value": 3, "z": 0.25}') == (0.0, 0.25, 0.0)


def test_missing_axes_are_zero_and_big_ones_are_clamped() -> None:
    assert wanted(b"{}") == (0.0, 0.0, 0.0)
    assert wanted(b'{"x": -7, "z": 1e9}') == (-1.0, 1.0, 0.0)
    assert wanted(b'{"z": 10000000000000000000000000}') == (0.0, 1.0, 0.0)


def test_numeric_strings() -> None:
    assert wanted(b'{"x": "0.5", "z": " -2.5e-1 ", "y": "+1"}') == (0.5, -0.25, 1.0)


def test_what_is_no_number_is_refused() -> None:
    strings = (
        '""',
        '"."',
        '"1_0"',
        '"0x1"',
        '"nan"',
        '"inf"',
        '"1 2"',
        '"-"',
        '"e5"',
        '"1e"',
        '"1.2.3"',
        '"1-2"',
        '"--1"',
    )
    for text in ("true", "null", "[1]", "{}") + strings:  # noqa: RUF005 - MicroPython has no star there
        for axis in ("x", "z", "y"):
            assert wanted(('{"' + axis + '": ' + text + "}").encode()) is None, text


def test_nan_and_infinity_are_refused() -> None:
    for text in (b"NaN", b"Infinity", b"-Infinity", b"1e999", b"-1e999", b'"1e999"', b'"NaN"', b"1" + b"0" * 400):
        assert wanted(b'{"x": 0, "z": ' + text + b"}") is None, text


def test_what_is_no_object_is_refused() -> None:
    for raw in (b"", b" ", b"1", b"[1, 1]", b'"x"', b"null", b'{"z": 1', b'{"z": 1}}', b'{"z": 1} x', b"\x00", b"z"):
        assert wanted(raw) is None, raw


def test_what_is_no_utf8_is_refused() -> None:
    assert wanted(b"\xff\xfe\x00") is None
    assert wanted(b'{"z": 1, "n": "\xff"}') is None
    assert wanted(b'{"z": 1, "n": "\xc3\xab"}') == (0.0, 1.0, 0.0)


def test_length_and_depth_have_limits() -> None:
    body = b'{"z": 1, "pad": "%s"}'
    room = 1024 - len(body % b"")
    assert wanted(body % (b"x" * room)) == (0.0, 1.0, 0.0)
    assert wanted(body % (b"x" * (room + 1))) is None
    assert wanted(b"[" * 1000) is None
    assert wanted(b'{"a":' * 40 + b"1" + b"}" * 40) is None
    assert wanted(b'{"z": 1, "a":' + b"[" * 20 + b"]" * 20 + b"}") == (0.0, 1.0, 0.0)
