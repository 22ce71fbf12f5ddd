"""Deliberate bugs in the MQTT connection (see tests/mutations.py)."""

from __future__ import annotations

import sys

from tests.mutations import main

MUTATIONS = """
what lay in the socket counts as fresh: test_mqtt_read_age.py -k after_a_stop or piled_up
transports/mqtt/read_age.py
- self.since, self.checked_at, self._counted = self.checked_at, now, size
+ self.since, self.checked_at, self._counted = now, now, size

the socket counts as empty after the process has slept: test_mqtt_connection.py -k while_it_waits
transports/mqtt/connection.py
- - began <= wait + OVERSLEPT_S:
+ - began <= 1e9:

what waited at the broker counts as fresh: test_mqtt.py -k waited_at_the_broker
transports/mqtt/read_age.py
-         if waited > 0:
-
+         if waited > 1e9:
+

no ping follows a time without reading: test_mqtt_connection.py -k ping_follows_at_once
transports/mqtt/pings.py
-         if since != self._stalled_since:
+         if False:

a ping with every read after a time without reading: test_mqtt_connection.py -k time_in_which_nothing_was_read
transports/mqtt/pings.py
-         if since != self._stalled_since:
+         for _ in range(50):

silence is not noticed: test_mqtt_connection.py -k is_silent or came_in_a_silence
transports/mqtt/connection.py
- if now - incoming.answered_at > incoming.silence_s:
+ if now - incoming.answered_at > 1e9:

pings are sent only in a silence: test_mqtt_connection.py -k while_other_answers_come
transports/mqtt/connection.py
- if now >= self.pings.due_at:
+ if now >= self.pings.due_at and now - incoming.answered_at > 0.4:

one late answer is a silence: test_mqtt_connection.py -k is_silent
transports/mqtt/pings.py
- return max(self._silence_s, 4 * self._in_flight.round_trip_s)
+ return self._silence_s / 4

retained messages do not show that the broker lives: test_mqtt_connection.py -k signs_of_life
transports/mqtt/incoming.py
-             age.has_retained = True
-
+             pass
+

pieces of a long message do not show that the broker lives: test_mqtt_connection.py -k signs_of_life
transports/mqtt/incoming.py
- if age.has_retained or (size and self._packets == first):
+ if age.has_retained:

the time in which retained messages are handled counts as silence: test_mqtt_connection.py -k handled_is_no_silence
transports/mqtt/connection.py
-             incoming.age.note_handled()
-
+             incoming.age.has_retained = False
+

the same, at a real broker: test_mqtt.py -k retained_messages_are_handled_is_no_silence
transports/mqtt/connection.py
-             incoming.age.note_handled()
+             incoming.age.has_retained = False

a lost connection sends what its socket still holds: test_mqtt_connection.py -k discarded_connection
transports/mqtt/connection.py
- sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _ABORT)
+ pass

messages are acknowledged before they are handled: test_mqtt_connection.py -k acknowledged_when_it_was_handled
transports/mqtt/connection.py
-             messages, incoming.messages = incoming.messages, []
-
+             client.acknowledge()
+             messages, incoming.messages = incoming.messages, []
+

a subscription is confirmed before its retained messages are delivered: test_mqtt_connection.py -k acknowledgement_is
transports/mqtt/connection.py
-         try:
-             if messages:
-
+         self._in_flight.complete()
+         try:
+             if messages:
+

any number of messages may be unacknowledged: test_mqtt.py -k unacknowledged_messages_are_bounded
transports/mqtt/connection.py
- self._in_flight.unacked >= UNACKED_LIMIT and
+ self._in_flight.unacked >= 10**9 and

stops have no room of their own: test_mqtt.py -k unacknowledged_messages_are_bounded
transports/mqtt/connection.py
- return beyond >= UNACKED_RESERVE or not self._owner.is_stop(message.topic)
+ return True

no ping follows a message that may be at fault: test_mqtt_connection.py -k may_be_at_fault
transports/mqtt/connection.py
- if (doubtful := self.pings.doubtful) and message.topic in doubtful:
+ if (doubtful := self.pings.doubtful) and not doubtful:

a broker that hangs up on a message is taken for a broken link: test_mqtt.py -k set_aside or hangs_up_costs
transports/mqtt/connection.py
-             return self._in_flight.first_written(clock.since_boot())
+             return None

a refused subscription counts as granted: test_mqtt.py -k refused_subscription or merged_filter
transports/mqtt/incoming.py
- (filter_, code >= reasons.FAILURE) for filter_, code in answers)
+ (filter_, False) for filter_, code in answers)

what the broker lacks is sent all the same: test_mqtt_broker_limits.py -k messages_pass_both_ways
transports/mqtt/connection.py
-             message = self.limits.fit(message)
-
+             pass
+

more is in flight than the broker takes: test_mqtt_client.py -k no_more_is_in_flight
transports/mqtt/client.py
-         if self._left <= 0:
+         if self._left <= -1000:

a ping's answer confirms what was sent after it: test_mqtt_outgoing.py -k answered_ping_proves
transports/mqtt/outgoing.py
- if entry.ping and entry.ping <= self._pong_number]
+ if entry.ping and entry.ping <= self._pong_number + 1]

older messages follow one that made them stale: test_mqtt_connection.py -k stale
transports/mqtt/connection.py
-                     self._counters.add("dropped", self._backlog.supersede(message))
+                     pass

a retained message is skipped although an older one of the batch may change that: test_mqtt_connection.py -k skip
transports/mqtt/incoming.py
-         if self.messages:
-             return False
+         if False:
+             return False

nothing says that another client has our client id: test_client_ids.py -k two_with_one_id
transports/mqtt/ending.py
- if id_ is not None and accepted and self._taken_over:
+ if False:
"""

if __name__ == "__main__":
    sys.exit(main(MUTATIONS, "tests/transports"))
