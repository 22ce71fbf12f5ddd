"""Both kinds of links, where the machine permits them."""

from collections.abc import Iterator

import pytest

from pebble.impair.link import Link, open_link, why_no_namespaces


@pytest.fixture
def namespaces_permitted() -> None:
    """Skips where they are not: asked when a test needs it, for they are made to find out."""
    if obstacle := why_no_namespaces():
        pytest.skip(f"no namespaces: {obstacle}")


@pytest.fixture(params=["namespaces", "proxy"])
def kind(request: pytest.FixtureRequest) -> str:
    if request.param == "namespaces":
        request.getfixturevalue("namespaces_permitted")
    return str(request.param)


@pytest.fixture
def link(kind: str) -> Iterator[Link]:
    with open_link(kind, name="of a test") as made:
        yield made
