"""The config of one robot. `pebble check --keys` lists every key; configs/schema.json tells editors."""

from pebble.config.config import LAUNCHER_LOCK as LAUNCHER_LOCK
from pebble.config.config import Config as Config
from pebble.config.config import config_of_process as config_of_process
from pebble.config.config import default_run_folder as default_run_folder
from pebble.config.config import hand_over as hand_over
from pebble.config.config import load as load
from pebble.config.config import parse as parse
from pebble.config.config import resolved as resolved
from pebble.config.security import Security as Security
from pebble.config.transport import Mqtt as Mqtt
from pebble.config.transport import RemoteConnection as RemoteConnection
from pebble.config.transport import RemoteMqtt as RemoteMqtt
from pebble.config.transport import Tls as Tls
from pebble.config.tree import MqttBridge as MqttBridge
from pebble.config.tree import SerialBridge as SerialBridge
from pebble.config.tree import SystemControl as SystemControl
from pebble.config.types import Secret as Secret
