"""The duties of a robot towards its drivers, see docs/your-robot.md: on a computer, and unchanged on a board."""

from control import Control
from emergency_stop import EmergencyStop
from payloads import clamp, command_of, is_number

OWNER = "motors"  # the name of what commands the motors
DEAD_MAN_MS = 750  # the longest time for which a command counts
PAUSE_MS = 500  # after a reset nothing moves until no command came for so long, or the driver sent a zero
HEARTBEAT_MS = 250


class Robot:
    """A robot with two wheels. A subclass has the methods that differ from robot to robot:

    ``turn(left, right)`` commands the motors, -1..1; ``publish(metric, value, qos)`` sends JSON, retained;
    ``save(text)`` writes a file; ``now()`` counts milliseconds and is never set; ``epoch_ms()`` is the time of day.
    """

    def __init__(self, robot_id, named, saved):
        """``named``: commands need an account; ``saved``: what ``save`` has written last, or None."""
        self.base = "pebble/robots/" + robot_id
        self.named = named
        self.stop = EmergencyStop(saved, self.save, named)
        self.control = Control()
        self.wheels = [0, 0]  # left and right as commanded, -1..1
        self.wheels_until = 0  # when they stop by themselves
        self.paused_until = 0
        self.heartbeat_at = 0
        self.shown = None  # the wheels and the control that were published last
        self.capabilities = {
            "identity": {"system": "pebble", "type": "robots", "id": robot_id},
            "drive": {"available": True, "controls": True, "control": True},  # pages may offer it
            "estop": {"available": True, "owners": [OWNER]},
            "named": named,
        }

    def connected(self):
        """Publish everything again: the broker may be another one."""
        value = {"t": self.epoch_ms(), "schema": "pebble-capabilities/v1", "value": self.capabilities}
        self.publish("capabilities", value, 1)
        self.stop.is_new = True
        self.shown = None

    def move(self, left, right, for_ms):
        self.wheels = [round(left, 3), round(right, 3)]
        self.wheels_until = self.now() + for_ms
        self.turn(left, right)

    def halt(self):
        self.move(0, 0, 0)

    def receive(self, topic, payload, retained):
        """Take one message below incoming/. A retained one is stale: it would be carried out at every start."""
        if retained:
            return
        metric = topic[len(self.base + "/incoming/") :]
        account = ""
        if metric.startswith("by/"):  # by/ACCOUNT/METRIC: the broker has checked this account
            account, _, metric = metric[len("by/") :].partition("/")
        command = command_of(payload)
        holder = self.control.holder
        if metric == "estop" and payload:  # a stop needs no account
            self.halt()
            self.stop.press(command or {}, account, self.epoch_ms())
        elif metric == "drive-values" and command is not None:  # nor does a zero: drive() decides
            self.drive(command, account)
        elif command is None or (self.named and not account):
            return
        elif metric == "estop-reset":
            if self.stop.reset(command):
                self.paused_until = self.now() + PAUSE_MS
        elif metric in ("control", "control/take"):
            self.control.request(command, account, metric == "control/take", self.now())
        if self.control.holder is not holder:
            self.halt()  # the next driver must not get a robot that moves

    def drive(self, command, account):
        x = command.get("x", 0)  # steers, to the right if positive
        z = command.get("z", 0)  # drives, ahead if positive
        valid_ms = command.get("valid_ms", DEAD_MAN_MS)
        if not (is_number(x) and is_number(z) and is_number(valid_ms)):
            return  # clamping NaN would give full speed
        x = clamp(x, -1, 1)
        z = clamp(z, -1, 1)
        by_holder = self.control.is_held_by(command.get("key"), account)
        keyless = "key" not in command and not self.named
        if by_holder:
            self.control.renew(self.now())
        if x == 0 and z == 0:
            self.halt()  # a zero needs no key
            if by_holder or self.control.is_free:
                self.paused_until = 0  # the driver has let go
        elif self.now() < self.paused_until:
            self.paused_until = self.now() + PAUSE_MS  # a stick that is held down since the stop moves nothing
        elif not self.stop.latched and (by_holder or keyless):
            self.move(clamp(z + x, -1, 1), clamp(z - x, -1, 1), clamp(valid_ms, 0, DEAD_MAN_MS))

    def tick(self):
        """Call it 50 times a second: it ends what is over, and publishes what has changed."""
        if self.now() >= self.wheels_until:
            self.halt()
        holder = self.control.holder
        self.control.tick(self.now())
        if self.control.holder is not holder:
            self.halt()
        control = dict(self.control.state(), named=self.named, boot=self.stop.boot)
        if self.shown != (self.wheels, control):
            self.shown = self.wheels, control
            self.publish("status", {"t": self.epoch_ms(), "value": {"wheels": self.wheels}}, 1)
            self.publish("control/" + OWNER, control, 1)
        if self.stop.is_new:
            self.stop.is_new = False
            if not self.stop.is_saved:
                self.stop.save()  # which may take a while: what has come meanwhile moves nothing
                self.paused_until = self.now() + PAUSE_MS
            self.publish("estop/" + OWNER, self.stop.state(), 1)
        if self.now() >= self.heartbeat_at:
            self.heartbeat_at = self.now() + HEARTBEAT_MS
            self.publish("online", {"t": self.epoch_ms()}, 0)
