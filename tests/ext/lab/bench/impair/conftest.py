"""Impaired networks, where the machine permits them."""

import re
from collections.abc import Iterator
from contextlib import closing

import pytest

from pebble.extensions.lab.bench.impair.network import NamespaceNetwork, why_no_namespaces


@pytest.fixture
def namespaces_permitted() -> None:
    """Skips without permission or programs, and fails for another reason; checked only when a test needs it."""
    if obstacle := why_no_namespaces():
        assert re.search("run it as root|not permitted|Permission denied|failed to execute", obstacle), obstacle
        pytest.skip(f"no namespaces: {obstacle}")


@pytest.fixture
def network(namespaces_permitted: None) -> Iterator[NamespaceNetwork]:
    with closing(NamespaceNetwork("of a test")) as made:
        yield made
