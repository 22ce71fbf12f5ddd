"""From a package and a file of answers to a robot with heartbeats, and a page on which its user logs in."""

from __future__ import annotations

import json
from typing import Any

from tests.kit.machine import Machine
from tests.life.robots import BASE, PORT, ROBOT, Robot
from tests.support import until

PASSWORD = "correct horse battery"
ANSWERS: dict[str, Any] = {
    "id": ROBOT,
    "port": PORT,
    "protocol": "goob_base_v1",
    "camera": "none",
    "broker": "here",
    "page": True,
    "user": "ann",
    "password_file": "/srv/password",
}
#: As a browser does, except that it takes the robot's own certificate as it comes.
LOG_IN = """
import json, ssl, urllib.request
context = ssl._create_unverified_context()
def ask(path, body=None):
    data = None if body is None else json.dumps(body).encode()
    headers = {"Content-Type": "application/json", "Origin": "https://127.0.0.1:8080"}
    request = urllib.request.Request("https://127.0.0.1:8080" + path, data, headers)
    return urllib.request.urlopen(request, context=context).status
print(ask("/"), ask("/api/login", {"user": "ann", "password": "%s"}))
"""


def test_package_and_setup_make_a_robot_with_heartbeats_and_let_its_user_in(machine: Machine) -> None:
    robot = Robot(machine)
    robot.plug_in()
    machine.write("/srv/password", PASSWORD)
    machine.write("/srv/answers.json", json.dumps(ANSWERS))
    machine.run("chmod", "600", "/srv/password")
    done = machine.run("pebble", "setup", "--answers", "/srv/answers.json", "--yes", timeout=300)
    assert PASSWORD not in done
    remote = json.loads(machine.run("cat", "/etc/pebble/robot.json"))["services"]["mqtt_bridge"]["remote_mqtt"]
    password = machine.sh(f"cd /etc/pebble && cat {remote['password_file']}").strip()
    login = ("-h", remote["host"], "-p", str(remote.get("port", 1883)), "-u", remote["username"], "-P", password)
    assert machine.succeeds("mosquitto_sub", *login, "-R", "-C", "5", "-W", "60", "-t", f"{BASE}/outgoing/online")
    script = LOG_IN % PASSWORD
    assert until(lambda: machine.run("python3", "-c", script, check=False) == "200 200\n", 60, step=1), done
    again = machine.run("pebble", "setup", "--answers", "/srv/answers.json", "--yes", timeout=300)
    assert " new " not in again
