"""Impaired networks, where the machine permits them."""

from collections.abc import Iterator

import pytest

from pebble.bench.impair.network import NamespaceNetwork, why_no_namespaces


@pytest.fixture
def namespaces_permitted() -> None:
    """Skips without permission; checked only when a test needs it, by creating them."""
    if obstacle := why_no_namespaces():
        pytest.skip(f"no namespaces: {obstacle}")


@pytest.fixture
def network(namespaces_permitted: None) -> Iterator[NamespaceNetwork]:
    with NamespaceNetwork("of a test") as made:
        yield made
