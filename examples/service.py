"""Publishes how long a robot has been up, on a topic of its own: python service.py goob.json, beside the robot.

`pebble up` starts it with the robot if its config has "extensions": {"service.py": {}}.
"""

import sys

from pebble import Channel, Kind
from pebble.runtime.process import run
from pebble.service import Service, every

UPTIME = Channel(metric="uptime", kind=Kind.EVENT, payload=dict)


class Uptime(Service):
    """The service: one process, one thread, no lock, and no word of MQTT or Zenoh."""

    name = "uptime"

    @every(1.0)
    def tell(self) -> None:
        self.publish(UPTIME, {"seconds": round(self.clock())})


if __name__ == "__main__":
    sys.exit(run(Uptime))
