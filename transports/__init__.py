"""Pub/sub transports. Everything above works with :class:`Transport`; only :func:`create` knows backends."""

from pebble.transports.base import Handler as Handler
from pebble.transports.base import Message as Message
from pebble.transports.base import QoS as QoS
from pebble.transports.base import State as State
from pebble.transports.base import Subscription as Subscription
from pebble.transports.base import Transport as Transport
from pebble.transports.outgoing import Outgoing as Outgoing
from pebble.transports.registry import check_kind as check_kind
from pebble.transports.registry import create as create
from pebble.transports.settings import MqttSettings as MqttSettings
from pebble.transports.settings import TlsSettings as TlsSettings
from pebble.transports.settings import ZenohSettings as ZenohSettings
