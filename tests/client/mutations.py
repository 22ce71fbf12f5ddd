"""Deliberate bugs in requests for pictures and sound, and in the robot as operators see it (see tests/mutations.py)."""

from __future__ import annotations

import sys

from tests.mutations import main

MUTATIONS = """
media queue, it begins at any frame: client/test_media_queue.py
pebble/client/media_request/queue.py
- self.waiting = True  # for a key frame
+ self.waiting = False

media queue, what follows a gap is sent: client/test_media_queue.py
pebble/client/media_request/queue.py
- elif self.waiting:
-             self.skipped += 1
-         elif self._has_room(frame):
+ elif self._has_room(frame):

media queue, any number is under way: client/test_media_queue.py
pebble/client/media_request/queue.py
- if under_way < self.window:
+ if under_way < 64:

media queue, a slow page has the window of a fast one: client/test_media_queue.py
pebble/client/media_request/queue.py
- if self.ack_s > SLOW_ACK_S:
+ if False:

media queue, small frames are bounded by nothing: client/test_media_queue.py
pebble/client/media_request/queue.py
- return under_way < SMALL_WINDOW and total <= SMALL_BYTES
+ return total <= SMALL_BYTES

media queue, bytes that wait have no bound: client/test_media_queue.py
pebble/client/media_request/queue.py
- len(self._queue) < limit and self._queued_bytes() + len(frame.data) <= MAX_QUEUED_BYTES
+ len(self._queue) < limit

media queue, frames that wait have no bound: client/test_media_queue.py
pebble/client/media_request/queue.py
- limit = SLOW_FRAMES if self._skips_early(frame) else MAX_FRAMES
+ limit = 1 << 20

media queue, a key frame replaces nothing: client/test_media_queue.py
pebble/client/media_request/queue.py
- if self.waiting or late or self._queued_bytes() + len(frame.data) > MAX_QUEUED_BYTES:
+ if self.waiting:

media queue, a frame acknowledged twice counts twice: client/test_media_queue.py
pebble/client/media_request/queue.py
- self._under_way.pop(seq, (0.0, None))
+ self._under_way.get(seq, (0.0, None))

media queue, a page that did not draw always waits: client/test_media_queue.py
pebble/client/media_request/queue.py
- if not any(frame.keyframe for frame in (*under_way, *self._queue)):
+ if True:

media queue, one late frame is a thin connection: client/test_media_queue.py
pebble/client/media_request/queue.py
- return self.late_acks >= THIN_FRAMES
+ return self.late_acks >= 1

media queue, frames under way together are late twice: client/test_media_queue.py
pebble/client/media_request/queue.py
- elif sent_at >= self._late_at:
+ else:

media queue, a rescued page returns at once: client/test_media_queue.py
pebble/client/media_request/queue.py
-  and now >= self._retry_at:
+ :

media queue, it returns after the same time always: client/test_media_queue.py
pebble/client/media_request/queue.py
- self._retry_s = min(_LAST_RETRY_S, 2 * self._retry_s)
+ pass

media queue, it never counts as recovered: client/test_media_queue.py
pebble/client/media_request/queue.py
- _FIRST_RETRY_S if now - self._direct_since > _RECOVERED_S else self._retry_s
+ self._retry_s

media queue, a page returns to what it cannot decode: client/test_media_queue.py
pebble/client/media_request/queue.py
- if self.decodes(frame.encoding):
+ if True:

media queue, old rescue pictures are sent: client/test_media_queue.py
pebble/client/media_request/queue.py
- if self.rescued:
-             self.wait_for_keyframe()
-             self.offer(frame)
+ if self.rescued:
+             self.offer(frame)

media queue, a slow viewer costs all a key frame: client/test_media_queue.py
pebble/client/media_request/queue.py
- if can_rescue and (viewer.overflowed or viewer.waiting_s(now) > _RESCUE_AFTER_S):
+ if False:

media queue, key frames of JPEGs are requested at once: client/test_media_queue.py
pebble/client/media_request/queue.py
- patience = 0.0 if encoding == "h264" else _JPEG_PATIENCE_S
+ patience = 0.0

media queue, a new viewer gets no key frame: client/test_media_queue.py
pebble/client/media_request/queue.py
- return bool(new)
+ return False

encoding, a pin is ignored: client/test_media_queue.py
pebble/client/media_request/encoding_choice.py
- if pinned in offered:
+ if False:

encoding, it gets better at once: client/test_media_queue.py
pebble/client/media_request/encoding_choice.py
- _BETTER_AFTER_S: Final = 5.0
+ _BETTER_AFTER_S: Final = 0.0

encoding, it gets worse after a while: client/test_media_queue.py
pebble/client/media_request/encoding_choice.py
- if not self._suits(offered, viewers) or wanted
+ if wanted

encoding, the last viewer that leaves changes it: client/test_media_queue.py
pebble/client/media_request/encoding_choice.py
- if not viewers and self.current in offered:
+ if False:

offer, topics of another robot are believed: web/media/test_requests.py -k topics_of_others
pebble/client/media_request/offer.py
- if section.get(key) is not None and not names(ref, section[key], channel):
+ if False:

offer, a medium without controls is requested: web/media/test_requests.py -k topics_of_others
pebble/client/media_request/offer.py
- if section.get("controls") is not True:
+ if False:

offer, an absent medium is requested: web/media/test_requests.py -k topics_of_others
pebble/client/media_request/offer.py
-  or section.get("available") is not True:
+ :

request, it is not withdrawn: web/media/test_requests.py -k last_one_withdraws
pebble/client/media_request/request.py
- await asyncio.to_thread(viewer.close)
+ pass

request, a page that reloads begins anew: web/media/test_requests.py -k reloads
pebble/client/media_request/request.py
- not self._wanted and time.monotonic() - self._wanted_at >= LINGER_S
+ not self._wanted

request, it is not repeated: web/media/test_requests.py -k again_while_nothing
pebble/client/media_request/request.py
- await asyncio.to_thread(viewer.repeat_requests)
+ pass

request, capabilities that change later end nothing: web/media/test_requests.py -k change_later
pebble/client/media_request/request.py
- if self.problem:
-             await self._withdraw()
-             return
+ if self.problem:
+             return

request, it stays at an old topic: web/media/test_requests.py -k moves_to_another
pebble/client/media_request/request.py
- if viewer is None or topics != self._topics:
+ if viewer is None:

request, another encoding is not requested: web/media/test_pictures.py -k encoding_is_one_that_all
pebble/client/media_request/request.py
- elif encoding == self.encoding:
+ elif True:

request, key frames are not requested: web/media/test_pictures.py -k wants_a_key_frame
pebble/client/media_request/request.py
- await asyncio.to_thread(self._viewer.request_keyframe, known)
+ pass

request, what arrives waits without bound: client/test_media_request.py
pebble/client/media_request/request.py
- if self._pending >= _MAX_PENDING or self._pending_bytes + size > _MAX_PENDING_BYTES:
+ if False:

request, it is withdrawn while there is no broker: client/test_media_request.py
pebble/client/media_request/request.py
- return idle and (self._broker.connected or self._viewer is None)
+ return idle

robot view, a retained heartbeat is a sign of life: client/test_discovery.py
pebble/client/robot_view.py
- if message.retain:
-             return None
-         try:
-             payload: Heartbeat
+ try:
+             payload: Heartbeat

robot view, a will means nothing: client/test_discovery.py
pebble/client/robot_view.py
- online=payload.online is not False)
+ online=True)

robot view, two heartbeats decide: client/test_discovery.py
pebble/client/robot_view.py
- len(self._intervals) < 2
+ len(self._intervals) < 1

robot view, a slow link is a silence: client/test_discovery.py
pebble/contract/levels.py
- max(2 * interval_s, 4 * late_s, LEVELS[link].silent_s)
+ max(2 * interval_s, LEVELS[link].silent_s)

silence, a thin link is one: client/test_silence.py client/test_discovery.py
pebble/contract/levels.py
- max(2 * interval_s, 4 * late_s, LEVELS[link].silent_s)
+ max(2 * interval_s, 4 * late_s)

silence, places of robots on a thin link are taken: client/test_silence.py
pebble/runtime/by_name.py
- silent_after(link=self.link)
+ silent_after()

silence, a removed link stays: client/test_silence.py
pebble/runtime/by_name.py
- known.link = level_of(message.payload)
+ known.link = level_of(message.payload) if message.payload else known.link

silence, pebble estop status does not: client/test_silence.py
pebble/client/discovery.py
- [silent_after(link=one.link) for one in robots
+ [silent_after() for one in robots

silence, a stop of all ends before a robot on a thin link is silent: client/test_silence.py
pebble/client/estop.py
- COLLECT_S = silent_after(link="thin")
+ COLLECT_S = silent_after()

silence, a script on a thin link is awaited as any: client/test_silence.py
pebble/client/scripts.py
- self._link = level_of(message.payload)
+ pass

robot view, a silent robot is online: client/test_discovery.py
pebble/client/robot_view.py
- return age <= silent_after(interval, self.link, self.average_latency_s or 0.0) or age < at_least_s
+ return True

robot view, one late heartbeat is a silence for people: client/test_discovery.py client/test_terminal_driver.py
pebble/client/robot_view.py
- return self.liveness.online(now, SILENT_S)
+ return self.liveness.online(now)

robot view, a pause counts as the interval of heartbeats: client/test_discovery.py
pebble/client/robot_view.py
-  and 0.05 <= now - self.received_at <= 10.0:
+ :

robot view, a wrong clock counts as a slow link: client/test_discovery.py
pebble/client/robot_view.py
- max(0.0, latency_s) if -1.0 <= latency_s <= 10.0 else None
+ max(0.0, latency_s)

robot view, a robot with a wrong clock is never online: client/test_discovery.py
pebble/client/robot_view.py
- or interval is None:
+ or interval is None or self.average_latency_s is None:

robot view, topics of another robot are used: client/test_discovery.py
pebble/client/robot_view.py
- isinstance(topic, str) and not is_of_another(topic, self.base)
+ isinstance(topic, str)

robot view, nonsense takes the capabilities away: client/test_discovery.py client/test_terminal_driver.py
pebble/client/robot_view.py
- self.capabilities = codec.decode(c.CAPABILITIES, message.payload).value
-             except PayloadError:
+ self.capabilities = codec.decode(c.CAPABILITIES, message.payload).value
+             except PayloadError:
+                 self.capabilities = {}

robot view, a robot without capabilities drives: client/test_discovery.py client/test_terminal_driver.py
pebble/client/robot_view.py
- drive.get("available") is True and drive.get("controls") is not False
+ drive.get("available") is not False

robot view, a robot that must not be controlled drives: client/test_discovery.py client/test_terminal_driver.py
pebble/client/robot_view.py
-  and drive.get("controls") is not False
+

robot view, a stopped robot is free: client/test_discovery.py client/test_terminal_driver.py
pebble/client/robot_view.py
- return bool(self.estop.latched)
+ return False

robot view, the end of a stop is not noted: client/test_terminal_driver.py
pebble/client/robot_view.py
- if latched and not self.latched:
+ if False:

robot view, a script is not seen: client/test_terminal_driver.py
pebble/client/robot_view.py
- script=script is not None and script.running,
+ script=False,

robot view, every robot decides between script and person: client/test_terminal_driver.py
pebble/client/robot_view.py
- .get("arbitrates") is True
+ .get("arbitrates") is not False

robot view, topics of strangers have no bound: client/test_discovery.py
pebble/client/robot_view.py
- if len(self.remembered) < MAX_REMEMBERED or message.topic in (
+ if True or message.topic in (

robot view, strangers keep capabilities out: client/test_discovery.py
pebble/client/robot_view.py
- c.CAPABILITIES.topic(self.base),
+

robot view, the battery is not read: client/test_discovery.py
pebble/client/robot_view.py
- self.volts = payload.value
+ pass
"""

if __name__ == "__main__":
    sys.exit(main(MUTATIONS, "tests"))
