"""What is received of a recorded robot."""

from __future__ import annotations

from pebble.extensions.operator.client.media_receiver import MediaReceiver
from pebble.transports import QoS
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.ext.recordings.demo_robots import DRIVE, FRED, MEDIA, recorded
from tests.support import until


def test_every_recorded_picture_and_sound_is_received() -> None:
    """Four encodings of pictures and two of sound, one after another, as the robot sent them."""
    hub, pictures, sounds = MemoryHub(), [], []
    camera, microphone = f"{FRED}/outgoing/front-camera", f"{FRED}/outgoing/audio"
    capabilities_topic = f"{FRED}/outgoing/capabilities"
    with MemoryTransport("robot", hub) as robot, MemoryTransport("viewer", hub) as viewer:
        robot.publish(capabilities_topic, recorded(DRIVE, capabilities_topic)[0], qos=QoS.DELIVERED, retain=True)
        receiver = MediaReceiver(viewer, FRED)
        receiver.on_picture = pictures.append  # type: ignore[method-assign]
        receiver.on_sound = sounds.append  # type: ignore[method-assign]
        receiver.wait_for_capabilities(5)
        receiver.request("video")
        receiver.request("audio")
        for topic, received in ((camera, pictures), (microphone, sounds)):
            for number, payload in enumerate(recorded(MEDIA, topic), 1):
                robot.publish(topic, payload)
                assert until(lambda received=received, number=number: len(received) == number)  # type: ignore[misc]
        receiver.close()
    assert list(dict.fromkeys(one.encoding for one in pictures)) == ["json", "pbvd", "pbvz", "h264"]
    sent = recorded(MEDIA, microphone)
    assert [one.sequence for one in sounds] == [int.from_bytes(payload[12:16]) for payload in sent]
    assert [one.encoding for one in sounds] == [{1: "pcm", 2: "opus"}[payload[5]] for payload in sent]
