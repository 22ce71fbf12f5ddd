"""Fred's board starts here: installed as /main.py. A robot on a serial line needs no settings."""

from common.run import run
from fred.robot import build

run(build, {})
