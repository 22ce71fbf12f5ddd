"""The board of Goob's inertial sensor starts here: installed as /main.py. A serial line needs no settings."""

from common.run import run
from goob_imu.robot import build

run(build, {})
