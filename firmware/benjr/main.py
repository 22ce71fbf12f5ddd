"""BenJr's board starts here: installed as /main.py."""

from benjr.robot import build
from common.run import run
from common.settings import load

run(build, load())
