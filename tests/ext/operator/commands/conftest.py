"""One broker for each module."""

from tests.commands.conftest import broker as broker
