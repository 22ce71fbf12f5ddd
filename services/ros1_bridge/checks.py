"""The checks of `pebble doctor` for a base with ROS 1."""

from collections.abc import Iterator

from pebble.check_result import CheckResult, failed, ok, warn
from pebble.config import Config
from pebble.services.ros1_bridge.config import Ros1
from pebble.services.ros1_bridge.wire import RosError


def checks(config: Config) -> Iterator[CheckResult]:
    """Yield the checks: the master answers, and some base listens to commands."""
    section = config.section(Ros1)
    if not section.enabled:
        return
    from pebble.services.ros1_bridge.xmlrpc_api import call

    master, topic = section.master(), "/" + section.ros.cmd_vel_topic.strip("/")
    try:
        _, subscribers, _ = call(master, "getSystemState", "/pebble_doctor")
    except (RosError, ValueError) as error:
        yield failed(
            f"the ROS master does not answer: {error}", "start roscore, or set services.ros1_bridge.ros.master_uri"
        )
        return
    if section.drives and topic not in {name for name, _ in subscribers}:
        yield warn(f"nobody subscribes to {topic}", "start the base, or set services.ros1_bridge.ros.cmd_vel_topic")
        return
    yield ok(f"the ROS master answers: {master}")
