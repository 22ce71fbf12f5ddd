"""What tests of extensions share with those of the core."""

from tests.commands.conftest import run as run
from tests.services.conftest import local as local
from tests.services.conftest import memory_rig as memory_rig
from tests.services.conftest import network as network
from tests.services.conftest import remote as remote
from tests.services.conftest import rig as rig
