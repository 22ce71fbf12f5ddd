"""The contract of all robots: `from pebble.contract import DRIVE`. `channels.py` declares it."""

from pebble.contract.channels import *  # noqa: F403 - every channel under its own name
