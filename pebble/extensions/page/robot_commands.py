"""Requests of pages to robots besides driving: the right that each needs, and the message to publish. Pure."""

from typing import Any, NamedTuple

import msgspec

from pebble import contract as c
from pebble.contract import Channel, codec
from pebble.contract import payloads as p
from pebble.extensions.fleet.roles import right_of
from pebble.extensions.operator.client.robot_topics import FLAGS, PLACES, names, section_of, topic_of
from pebble.extensions.page import messages as m
from pebble.transports import Message, QoS


class _Command(NamedTuple):
    channel: Channel
    value: Any
    names: dict[str, str] = {}  # that fill the pattern of the channel's topic  # noqa: RUF012 - never changed


_ACTIONS = {"reboot": c.REBOOT, "service-restart": c.SERVICE_RESTART, "git-pull": c.GIT_PULL}
_DESCRIBE = c.MCU_DESCRIBE.metric.rpartition("/")[2]  # on this topic bridges ask each other whose device it is
_FLAGS = {flag.metric.removeprefix("flags/"): flag for flag in FLAGS.values()}


def channel_for(op: m.RobotOp) -> Channel:
    """Return the channel of this request."""
    return _command(op).channel


def right(op: m.RobotOp) -> str:
    """Return the right that a person needs for this request."""
    return right_of(channel_for(op))


def ends(op: m.RobotOp) -> bool:
    """True if the request ends something. Then it is sent whatever the component's state."""
    match op:
        case m.SoundboardOp(file="") | m.AutonomyOp(file="") | m.FlagOp(on=False) | m.OutletOp(on=False):
            return True
        case m.LightsOp(r=0, g=0, b=0):
            return True
    return False


def moves(op: m.RobotOp) -> bool:
    """True if the request may move something or switch it on. Then it needs a connection that may drive."""
    return isinstance(op, m.AutonomyOp | m.McuOp | m.OutletOp) and not ends(op)


def refusal(op: m.RobotOp, capabilities: dict[str, Any]) -> str:
    """Return why a component with these capabilities does not get this request; empty if it does.

    Also empty if the capabilities do not mention it.
    """
    if isinstance(op, m.McuOp) and op.name == _DESCRIBE:
        return f"{op.name} is no command of a microcontroller"
    command = _command(op)
    section, key = PLACES.get(command.channel, ("", ""))  # where the capabilities may name its topic
    if isinstance(op, m.ActionOp):
        described = (section_of(capabilities, section) for section in _sections(op))
        offer = next(filter(None, described), {})  # under the first of its possible names that is there
    elif isinstance(op, m.OutletOp):
        offer = _outlet_offer(capabilities, op.outlet)
    else:
        offer = section_of(capabilities, section)
    # The section of lights that do not flash has "flash": false, a key like that of the topic, "flash_topic".
    refusing_keys = ("available", "controls", key.removesuffix("_topic"))
    if not any(offer.get(refusing_key) is False for refusing_key in refusing_keys):
        return ""
    name, metric = op.ref.rpartition("/")[2], command.channel.metric.format(**command.names)
    return f"{name} takes no {metric} commands"


def _outlet_offer(capabilities: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the part of the capabilities about this outlet; empty if there is none."""
    outlets = section_of(capabilities, "outlets").get("outlets")
    for outlet in outlets if isinstance(outlets, list) else ():
        if isinstance(outlet, dict) and outlet.get("name") == name:
            return outlet
    return {}


def publication(op: m.RobotOp, capabilities: dict[str, Any]) -> Message:
    """Return the message to publish, on the topic that the capabilities name, or else on the contract's."""
    command = _command(op)
    channel = command.channel
    if isinstance(op, m.ActionOp):
        topic = _action_topic(op, channel, capabilities)
    elif channel in PLACES:  # the capabilities may name its topic
        topic = topic_of(op.ref, capabilities, channel)
    else:
        topic = channel.topic(op.ref, **command.names)
    qos = QoS(channel.default_qos)
    return Message(topic, codec.encode(channel, command.value), qos=qos, retain=channel.default_retain)


def _action_topic(op: m.ActionOp, channel: Channel, capabilities: dict[str, Any]) -> str:
    """Return the topic of an action: the first one that the capabilities name."""
    for section in _sections(op):
        for key in ("flag_topic", "topic"):
            topic = section_of(capabilities, section).get(key)
            if names(op.ref, topic, channel):  # a topic of this component, and of no other channel
                return str(topic)
    return channel.topic(op.ref)


def _sections(op: m.ActionOp) -> list[str]:
    """Return the names that capabilities may give the section of this action; the original page accepts all of them."""
    names = (op.name.replace("-", "_"), op.name)
    return [f"system.{name}" for name in names] + list(names)


def _command(op: m.RobotOp) -> _Command:
    """Return the channel of a request, and the value to publish there."""
    match op:
        case m.LightsOp(r=r, g=g, b=b, period=None):
            return _Command(c.LIGHTS_SOLID, p.LightsSolid(r=r, g=g, b=b))
        case m.LightsOp(r=r, g=g, b=b, period=period):
            return _Command(c.LIGHTS_FLASH, p.LightsFlash(r=r, g=g, b=b, period=period or 0))
        case m.SoundboardOp(file=file, repeat=repeat):
            play = p.SoundboardCommand(action="play", enabled=True, file=file, repeat=repeat or msgspec.UNSET)
            stop = p.SoundboardCommand(action="stop", enabled=False)
            return _Command(c.SOUNDBOARD_COMMAND, play if file else stop)
        case m.AutonomyOp(file=file, config=config):
            start = p.AutonomyCommand(action="start", file=file, config=config)
            return _Command(c.AUTONOMY_COMMAND, start if file else p.AutonomyCommand(action="stop"))
        case m.OutletOp(outlet=outlet, on=on):
            return _Command(c.OUTLET_COMMAND, p.OutletCommand(on=on), names={"outlet": outlet})
        case m.McuOp(uid=uid, name=name, value=value):
            return _Command(c.MCU_COMMAND, value, names={"uid": uid, "name": name})
        case m.ActionOp(name=name):
            return _Command(_ACTIONS[name], True)
        case m.FlagOp(name=name, on=on):
            return _Command(_FLAGS[name], on)
