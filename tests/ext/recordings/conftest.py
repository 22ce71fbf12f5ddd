"""The fixture of tests that run commands."""

from tests.commands.conftest import run as run
