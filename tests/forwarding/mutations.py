"""Deliberate bugs in bridge, mirror and what they are made of (see tests/mutations.py)."""

from __future__ import annotations

import sys

from tests.mutations import main

MUTATIONS = """
late commands pass: test_forwarding.py::TestLate
pebble/forwarding/forwarder.py
- if waited_s > subject.waits_s and
+ if False and

late zeros are dropped: test_forwarding.py::TestLate
pebble/forwarding/forwarder.py
-  and not ends_something(subject, message):
+ :

a zero ends nothing: test_forwarding.py::TestLate
pebble/contract/payloads.py
- return not self.moves
+ return False

lights wait no longer than drive commands: test_forwarding.py::TestLate
pebble/contract/channels.py
- waits_s=_PATIENT_S, override=_serial("lights_solid")
+ override=_serial("lights_solid")

commands of any size pass: test_forwarding.py::TestAdmission
pebble/forwarding/admission.py
- len(message.payload) > MAX_COMMAND_BYTES and
+ False and

unknown flags have no bound: test_forwarding.py::TestAdmission
pebble/forwarding/admission.py
- or len(self._flags) < MAX_UNKNOWN_FLAGS:
+ or True:

a live stop that asks to be retained is refused: test_services.py::TestStops
pebble/forwarding/forwarder.py
- elif not here.window.is_old_stop(message):
+ elif False:

a retained stop passes: test_services.py::TestStops
pebble/forwarding/forwarder.py
- elif not here.window.is_old_stop(message):
+ else:

retained messages of a slow link end no later: test_forwarding.py::TestStops
pebble/forwarding/retained_window.py
- self._stops_until = max(self._until, self._newest_at + INITIAL_SYNC_S)
+ self._stops_until = self._until

stops are old as long as others are retained: test_forwarding.py::TestStops
pebble/forwarding/retained_window.py
- min(max(now + INITIAL_SYNC_S, until), end)
+ max(now + INITIAL_SYNC_S, until)

a lost connection is not noted: test_forwarding.py::TestStops
pebble/forwarding/side.py
-             self.subscribing()  # the transport does so at the next connection
-
+

a lost connection synchronizes nothing: test_services.py::TestFlags
pebble/forwarding/side.py
- self.restarted = True
-             self._lost_at
+ self._lost_at

flags pass without a decision: test_services.py::TestFlags
pebble/forwarding/retained_topics.py
- if subject.kind in self._both_ways:
-                 drop
+ if False:
+                 drop

what has waited for the gate is lost: test_services.py::TestOutage
pebble/forwarding/retained_topics.py
- self._publish(Side.REMOTE, subject, message, forward)
+ pass

a change during an outage counts as any other: test_services.py::TestFlags
pebble/forwarding/retained_topics.py
- other_away=not self._sides[side.other].connected
+ other_away=False

the winner's old value counts after an outage: test_services.py::TestFlags
pebble/forwarding/reconciliation.py
- if topic in self._overtaken or topic in self._newer:
+ if False:

a probe that comes back where it was sent proves a cycle: test_cycles.py::TestCycles
pebble/forwarding/cycles.py
- if sent_to is side.other:
+ if sent_to is not None:

stops circulate: test_cycles.py::TestOthers
pebble/forwarding/cycles.py
- return Finding.CIRCULATES if self._repeats_stop(
+ return Finding.PASS if self._repeats_stop(

what runs something may run twice: test_cycles.py::TestOthers
pebble/forwarding/publisher.py
- if subject.runs or (not
+ if (not

commands are not probed again: test_cycles.py::TestSeveralBridges
pebble/forwarding/publisher.py
-         if self._cycles.closed_ways:
-             for
+         if False:
+             for

what asks to be retained passes: test_services.py::TestOneShots
pebble/forwarding/routing.py
- (message.retain or message.retain_requested):
-         return Drop.STALE
+ message.retain:
+         return Drop.STALE

scripts of others drive: test_forwarding.py::TestSignatures
pebble/forwarding/signatures.py
- return None if drive.moves else
+ return payload if drive.moves else

an account speaks for another one: test_names.py::TestSign
pebble/forwarding/names.py
- found.pop("by", None)
-                 body["by"] = by
+ body.setdefault("by", by)

a stranger keeps a claimed name: test_names.py::TestWithoutName
pebble/forwarding/names.py
- if account != NO_ACCOUNT and isinstance(
+ if isinstance(

what takes no name passes without: test_names.py::TestSign
pebble/forwarding/names.py
- if channel is not None and form not in _BARE:
+ if False:

strangers do everything: test_names.py::TestWithoutName
pebble/forwarding/names.py
- if channel is None or not (
+ if channel is None and not (

a zero needs a name: test_names.py::TestWithoutName
pebble/forwarding/names.py
- channel.suffix in self._strangers or _is_zero(channel, payload)
+ channel.suffix in self._strangers

a stop needs a name: test_names.py::TestWithoutName
pebble/forwarding/names.py
- if form is EstopCommand:
-                 return
+ if False:
+                 return

what is retained below a name passes: test_names.py::TestSign
pebble/forwarding/names.py
- elif (message.retain or message.retain_requested) and
+ elif message.retain and

a stop below a name is skipped as retained: test_names.py::TestStops
pebble/forwarding/forwarder.py
- return False  # it may be a live one
+ pass

a flag by name reaches one side: test_names.py::TestFlags
pebble/forwarding/forwarder.py
- if by != NO_ACCOUNT and subject.kind is Kind.FLAG
+ if False

a broker's old flag counts against the robot's: test_names.py::TestFlags
services/mqtt_bridge/service.py
- return Side.LOCAL if self.config.security.named else Side.REMOTE
+ return Side.REMOTE

flags without a name count: test_names.py::TestFlags
pebble/forwarding/retained_topics.py
- if old and not retained:
+ if False:

the newest event is dropped: test_services.py::TestOutage
pebble/forwarding/event_buffer.py
- self._waiting.popleft()
-             self._counters
+ self._waiting.pop()
+             self._counters

a bridge does not ask whether its sides are one: test_services.py::TestOneBroker
services/mqtt_bridge/service.py
- if not self._same_broker.possible:
+ if True:

a shut gate is not checked again: test_services.py::TestOneBroker
pebble/forwarding/service.py
-         self.check_later()
-
+

what the robot still has is removed: links/test_table.py -k took_back_while_no_bridge_ran
services/mqtt_bridge/leftovers.py
- return topic in here or max(
+ return max(

what the robot took back stays: links/test_table.py -k took_back_while_no_bridge_ran
services/mqtt_bridge/leftovers.py
- if message.retain and message.payload and len(self._there) <= _TOPICS:
+ if False:

a mirror serves the bridge's broker: test_services.py::TestWrongBroker
services/mqtt_mirror.py
- if self._probes.see(message.payload):
+ if False:

a heartbeat over a thin link is always an old one: test_services.py::TestWrongBroker
services/mqtt_mirror.py
- bridge.heartbeat.interval_seconds, bridge.link.slowest
+ bridge.heartbeat.interval_seconds

the same, at a real broker: links/test_other_ways.py -k mirror_of_the_bridges_broker
services/mqtt_mirror.py
-             if self._probes.announce(message.payload):
+             if False:

a mirror forgets the proof while the bridge is away: test_services.py::TestWrongBroker
services/mqtt_mirror.py
- if self._is_operators and not self._announced:
+ if False:

any heartbeat proves that the broker is the remote one: test_services.py::TestWrongBroker
services/mqtt_mirror.py
- if self._probes.see(message.payload):
+ if True:

a retained stop passes, at real brokers: links/test_table.py -k both_sides_are_there
pebble/forwarding/forwarder.py
- elif not here.window.is_old_stop(message):
+ else:

flags pass without a decision, at real brokers: links/test_table.py -k flags_that_differ
pebble/forwarding/retained_topics.py
- if subject.kind in self._both_ways:
-                 drop
+ if False:
+                 drop

what is retained is lost in an outage, at real brokers: links/test_table.py -k one_side_is_away
pebble/forwarding/retained_topics.py
- self._publish(Side.REMOTE, subject, message, forward)
+ pass

a restored side counts as any other: links/test_restored.py
pebble/forwarding/side.py
- self._went_back = self._was_brief and self.transport.went_back
+ self._went_back = False

a state without a place is lost: test_thin.py::TestStreams
pebble/forwarding/sieve.py
- return False  # no state is lost
+ return True

streams go before states: test_thin.py::TestNoRoom
pebble/forwarding/sifter.py
- self._send(self._sieve.due(Rank.STATE))
+ self._send(self._sieve.due(Rank.STREAM))

what waits stays on a link that is wide again: test_thin.py::TestStreams
pebble/forwarding/sifter.py
- self._send(before.empty())
+ pass

one late answer is a queue that stands: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
- else _STANDS_S)
+ else 0.0)

a queue that has nearly drained stands no more: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
- queue_s < _DRAINED_S if
+ queue_s < _STANDING_S if

a queue that has drained for a moment stands no more: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
- (_DRAINED_FOR_S if
+ (0.0 if

a queue of the last connection stands: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
-         self._crowd = Crowd()
-         self._forget()
+         self._forget()

operators do not learn that a queue stands: test_thin.py::TestLevels
services/mqtt_bridge/uplink.py
- (_CROWDED_DRIVE if meter.crowded else 1)
+ 1

streams fill a queue that stands: test_thin.py::TestLevels
services/mqtt_bridge/uplink.py
- (_CROWDED_STREAMS if self._meter.crowded else 1)
+ 1

the level alone is looked at: test_thin.py::TestLevels
services/mqtt_bridge/uplink.py
- return (self._meter.level, self._meter.crowded) != (self._level, self._crowded)
+ return self._meter.level != self._level

who floods keeps the robot away: test_thin.py::TestFloods
services/mqtt_bridge/uplink.py
-  and since_s >= RENEW_S:
+ :

commands that come late renew nothing: test_thin.py::TestFloods
services/mqtt_bridge/uplink.py
-         self._drop_late()
+         pass

one late answer lowers the level: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
- in self._newest) >= 2:
+ in self._newest) >= 1:

losses lower the level: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
- queue_s if tcp_queue_s is None else min(queue_s, tcp_queue_s)
+ queue_s

a rise that fails costs nothing: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
- if failed else _RULES
+ if False else _RULES

a rise that fails costs ever more: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
- min(2 * self._rise_s[lower], _LONGEST_WAIT_S)
+ 2 * self._rise_s[lower]

an answer of the last connection counts: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
- self._newest.clear()
+ pass

a short queue ends no rest: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
-         if self.queue_s >= _REST_S:
-             self._rests_since = None
-         elif
+         if

the norm is that of a minute: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
- _REMEMBERED_S, _PART_S = 600.0, 60.0
+ _REMEMBERED_S, _PART_S = 60.0, 60.0

a level that is set changes: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
- self._fixed = thin or profile != "auto"
+ self._fixed = False

a full room stays as large: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
- 0.7 * self._bytes
+ self._bytes

room that is not needed grows: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
- elif self._used:
+ else:

a large message needs an empty way: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
- min(size, self._bytes)
+ size

what is sent takes no room: ../services/mqtt_bridge/test_link.py
services/mqtt_bridge/link.py
- self._waiting += size
+ pass

who keeps to the pace of the link floods it: test_thin.py::TestFloods
pebble/forwarding/forwarder.py
- if forward.stamped and STAMP not in message.payload:
+ if forward.stamped:

a command in time ends no run of late ones: test_thin.py::TestFloods
pebble/forwarding/forwarder.py
-             if forward.stamped:
-                 self.ages.late.count = 0
+

late commands that are far apart are a run: test_thin.py::TestFloods
pebble/forwarding/command_ages.py
- or now - self._newest_at > _RUN_S:
+ or False:

a media flag is not gated: ../services/mqtt_bridge/test_bridge_media.py -k TestBridge
services/mqtt_bridge/own_requests.py
- self._post(flag, partial(self._media.allow, flag, self._boolean(flag, payload)), newest_of=flag.metric)
+ self._post(flag, partial(self._media.allow, flag, True), newest_of=flag.metric)
"""

if __name__ == "__main__":
    sys.exit(main(MUTATIONS, "tests/forwarding"))
