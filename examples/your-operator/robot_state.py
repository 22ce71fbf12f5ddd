"""The state of a robot as an operator knows it, by the robot's messages."""

import json
import math
import time

METRICS = ("online", "capabilities", "link", "estop/+", "control/+")
SILENT_S = {"wide": 1.5, "narrow": 3.0, "thin": 5.0}  # without a heartbeat, by the level of the link
WIDE = {"level": "wide", "drive_hz": 20}  # a link that carries everything: robots that report none have it


class RobotState:
    """The state of one robot."""

    def __init__(self):
        self.capabilities = {}
        self.link = WIDE  # what the way to the robot carries
        self.stops = {}  # the state of the emergency stop, by the name of each owner of motors
        self.controls = {}  # who has control, by the same
        self.is_offline = True
        self.heartbeat_at = -math.inf
        self.shown_holder = ""  # who has control, as it was printed last

    def disconnect(self):
        self.is_offline = True
        self.controls = {}

    def receive(self, metric, payload, retained):
        """Handle a message below outgoing/. A message that cannot be read changes nothing."""
        try:
            self.take(metric, json.loads(payload) if payload else {}, retained)
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            print("cannot be read:", metric, payload[:80], flush=True)

    def take(self, metric, value, retained):
        name, _, owner = metric.partition("/")
        if name == "online" and not retained:  # a retained heartbeat is no sign of life
            self.heartbeat_at = time.monotonic()
            self.is_offline = value.get("online") is False
        elif name == "capabilities":
            self.capabilities = dict(value["value"])
        elif name == "link":
            self.link = {"level": str(value["level"]), "drive_hz": float(value["drive_hz"])} if value else WIDE
        elif name == "estop":
            self.stops[owner] = dict(value)
        elif name == "control":
            self.controls[owner] = dict(value)
            if value.get("asks"):
                print(value["asks"], "asks for control", flush=True)

    def is_wide(self):
        return self.link["level"] == "wide"

    def is_silent(self):
        limit_s = SILENT_S.get(self.link["level"], SILENT_S["wide"])
        return self.is_offline or time.monotonic() > self.heartbeat_at + limit_s

    def known(self, states):
        """Return the states without those of unlisted owners, which a broker keeps after a renaming."""
        owners = (self.capabilities.get("estop") or {}).get("owners")
        return {owner: state for owner, state in states.items() if not owners or owner in owners}

    def is_stopped(self):
        return any(stop.get("latched") is not False for stop in self.known(self.stops).values())

    def has_stop(self, name):
        """True if each owner of motors reports the emergency stop of this name."""
        owners = (self.capabilities.get("estop") or {}).get("owners") or list(self.stops)
        confirmed = [name in self.stops.get(owner, {}).get("recent", ()) for owner in owners]
        return bool(confirmed) and all(confirmed)

    def gives_control(self):
        """True if the robot moves only by commands with the key of the client that has control."""
        return (self.capabilities.get("drive") or {}).get("control") is True

    def key(self, own_id):
        """Return the keys of all owners that gave control to this id, with spaces between.

        The first owner by name decides: without its key the text is empty.
        """
        keys = []
        for _, control in sorted(self.known(self.controls).items()):
            keys.append(str(control.get("key") or "") if control.get("id") == own_id else "")
        return " ".join(filter(None, keys)) if keys and keys[0] else ""

    def show_holder(self, own_id):
        """Print, once, that another client has control."""
        holder = ""
        for control in self.known(self.controls).values():
            if control.get("key") and control.get("id") != own_id:
                holder = str(control.get("by") or "another")
        if holder not in ("", self.shown_holder):
            print(holder, "has control, asking", flush=True)
        self.shown_holder = holder
