"""Networks of both kinds, where the machine permits them."""

from collections.abc import Iterator

import pytest

from pebble.bench.impair.network import ImpairedNetwork, open_network, why_no_namespaces


@pytest.fixture
def namespaces_permitted() -> None:
    """Skips without permission; checked only when a test needs it, by creating them."""
    if obstacle := why_no_namespaces():
        pytest.skip(f"no namespaces: {obstacle}")


@pytest.fixture(params=["namespaces", "proxy"])
def kind(request: pytest.FixtureRequest) -> str:
    if request.param == "namespaces":
        request.getfixturevalue("namespaces_permitted")
    return str(request.param)


@pytest.fixture
def network(kind: str) -> Iterator[ImpairedNetwork]:
    with open_network(kind, name="of a test") as made:
        yield made
