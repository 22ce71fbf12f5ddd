"""The capabilities of a robot on Wi-Fi (paper A.8.6). Pure."""

import json

from micropython import const

# It also lists what the robot does not offer, because readers assume the presence of what is missing.
_CAPABILITIES = const(
    b'{"schema":"pebble-capabilities/v1","t":%d,"value":{%s"identity":{"system":"%s","type":"%s","id":"%s"%s},'
    b'"transport":{"kind":"mqtt"},"drive":{"available":true,"controls":true,"arbitrates":true,"axes":["x","z"%s],'
    b'"control":%s,"topic":"%s/incoming/drive-values"},"estop":{"available":%s,"topic":"%s/incoming/estop",'
    b'"reset_topic":"%s/incoming/estop-reset","owners":["mcu"],"status_topics":["%s/outgoing/estop/mcu"]},'
    b'"telemetry":{"touch_sensors":false,"charging_status":%s,"charging_topic":"%s/outgoing/charging-status",'
    b'"charging_level_topic":"%s/outgoing/charging-level"},"lights":{"solid":false,"flash":false},"video":%s,"audio":%s,'
    b'"soundboard":%s,"autonomy":%s,"system":{"reboot":%s,"service_restart":%s,"git_pull":%s}}}'
)


def describe(epoch_ms: int, root: bytes, name: str, stops, charging: bytes, axes: bytes, groups: bytes) -> bytes:
    """Return the payload; ``root`` is the base of the topics, ``name`` the robot's name for people, or empty.

    ``stops`` is the `EmergencyStop`. The others are pieces of JSON. ``charging``: true if it reports that status.
    ``axes``: those besides x and z, such as ``,"y"``. ``groups``: what it takes in a group of commands, such as
    ``"groups":["drive-values"],``; empty: it takes none.
    """
    can, cannot = b"true", b"false"
    named = b',"name":' + json.dumps(name).encode() if name else b""
    # in the order of their places in the template
    values = [epoch_ms, groups + (b'"named":true,' if stops.names else b"")] + root.split(b"/")
    values += [named, axes, can if stops.controllable else cannot, root, can if stops.stoppable else cannot]
    values += [root, root, root, charging, root, root]
    # last the seven places from video to git_pull, which no board offers
    return _CAPABILITIES % tuple(values + [b'{"available":false,"controls":false}'] * 7)
