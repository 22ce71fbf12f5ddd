"""Installed as /main.py. A board on a serial line needs no settings."""

from common.run import run
from outlets.robot import build

run(build, {})
