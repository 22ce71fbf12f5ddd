"""What is received of a recorded robot."""

from __future__ import annotations

from pebble.extensions.operator.client.media_receiver import MediaReceiver
from pebble.transports import QoS
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.ext.recordings.demo_robots import DRIVE, FRED, MEDIA, recorded
from tests.ext.recordings.replayed import Plays
from tests.support import until


def test_every_recorded_picture_and_sound_is_received(recording: Plays) -> None:
    """Four encodings of pictures and two of sound, one after another, as the robot sent them."""
    hub, pictures, sounds = MemoryHub(), [], []
    capabilities_topic = f"{FRED}/outgoing/capabilities"
    with MemoryTransport("robot", hub) as robot, MemoryTransport("viewer", hub) as viewer:
        robot.publish(capabilities_topic, recorded(DRIVE, capabilities_topic)[0], qos=QoS.DELIVERED, retain=True)
        receiver = MediaReceiver(viewer, FRED)
        receiver.on_picture = pictures.append  # type: ignore[method-assign]
        receiver.on_sound = sounds.append  # type: ignore[method-assign]
        receiver.wait_for_capabilities(5)
        receiver.request("video")
        receiver.request("audio")
        recording(MEDIA, hub)
        sent = recorded(MEDIA, f"{FRED}/outgoing/front-camera"), recorded(MEDIA, f"{FRED}/outgoing/audio")
        assert until(lambda: (len(pictures), len(sounds)) == (len(sent[0]), len(sent[1])))
        receiver.close()
    assert list(dict.fromkeys(one.encoding for one in pictures)) == ["json", "pbvd", "pbvz", "h264"]
    assert [one.sequence for one in sounds] == [int.from_bytes(payload[12:16]) for payload in sent[1]]
    assert [one.encoding for one in sounds] == [{1: "pcm", 2: "opus"}[payload[5]] for payload in sent[1]]
