"""MiniLAMP's board starts here: installed as /main.py."""

from common.run import run
from common.settings import load
from minilamp.robot import build

run(build, load())
