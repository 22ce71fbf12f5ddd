"""The page looks as it did: pictures of a few states are those in tests/web/page/looks (``make long PART=looks``)."""

from __future__ import annotations

import numpy as np
import pytest
from playwright.sync_api import Browser

from tests.web.canned import CannedServer
from tests.web.looks import FAILED, LOOKS, MOST_BYTES, SHARE, STORED, check, difference, stored, taken

pytestmark = [pytest.mark.page, pytest.mark.timeout(180)]

#: What a change may break unseen, as rules besides the page's own.
BREAKS = {
    "another font": "body, button { font-family: serif; }",
    "a thinner title": ".card-head h2 { font-weight: 400; }",
    "another colour": "button.primary { background: #777 !important; }",
    "a wider gap": ".picture-bar { gap: 8px; }",
}


@pytest.mark.parametrize("name", LOOKS)
def test_a_state_looks_as_it_is_stored(server: CannedServer, browser: Browser, name: str) -> None:
    check(name, taken(server, browser, LOOKS[name]))


@pytest.mark.parametrize("style", BREAKS.values(), ids=BREAKS)
def test_what_breaks_a_look_is_shown(server: CannedServer, browser: Browser, style: str) -> None:
    broken = taken(server, browser, LOOKS["free"], style)
    with pytest.raises(AssertionError, match=r"free looks different in .*free\.actual\.png and .*difference\.png"):
        check("free", broken)
    for what in ("actual", "difference"):
        path = FAILED / f"free.{what}.png"
        assert path.read_bytes().startswith(b"\x89PNG")
        path.unlink()


def test_smoothed_edges_are_no_difference() -> None:
    picture = stored("free")
    noise = np.random.default_rng(1).integers(-5, 6, picture.shape)
    assert difference(np.clip(picture + noise, 0, 255).astype(np.uint8), picture).share <= SHARE
    assert difference(picture[:-2], picture).share == 1


def test_there_is_one_picture_for_each_state_and_they_are_small() -> None:
    assert {path.stem for path in STORED.iterdir()} == set(LOOKS)
    assert sum(path.stat().st_size for path in STORED.iterdir()) <= MOST_BYTES
