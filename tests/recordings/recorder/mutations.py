"""Deliberate bugs in the recorder (see tests/mutations.py)."""

from __future__ import annotations

import sys

from tests.mutations import main

MUTATIONS = """
the queue has no bound: test_recorder.py -k slow_disk
pebble/recordings/recorder/intake.py
- BoundedQueue[Item](_MOST_WAITING, limit - limit // 4)
+ BoundedQueue[Item](_MOST_WAITING, 1 << 40)

pictures push state out: test_recorder.py -k slow_disk
pebble/recordings/recorder/intake.py
- queue = self._media if is_media(payload) else self._state
+ queue = self._media

what the queue drops is not counted: test_recorder.py -k slow_disk
pebble/recordings/recorder/intake.py
- self._counters["dropped"] += len(lost)
+ self._counters["dropped"] += 0

what is dropped is not written down: test_recorder.py -k slow_disk
pebble/recordings/recorder/writing.py
- if total > self._noted_drops and self._blocked is None:
+ if False:

what waits is written in no order: test_recorder.py -k flags or times_are
pebble/recordings/recorder/intake.py
- return sorted(items, key=_when)
+ return items[::-1]

others may forge events: test_recorder.py -k forged
pebble/recordings/recorder/recorder.py
- if topic.startswith("$recorder/") or len(payload) > LARGEST_PAYLOAD:
+ if len(payload) > LARGEST_PAYLOAD:

pictures are recorded where they are not wanted: test_recorder.py -k no_media
pebble/recordings/recorder/recorder.py
- elif self.options.media or not is_media(payload):
+ else:

a file takes the time of its writing: test_recorder.py -k times_are
pebble/recordings/recorder/writing.py
- at_ns = self._clock.at(item.boot_ns)
+ at_ns = self._clock.now()

each robot has files without bound: test_recorder.py -k have_files_of_their_own
pebble/recordings/recorder/open_files.py
-  or media < _MOST_MEDIA else OTHER_MEDIA
+  or True else OTHER_MEDIA

the file of the state counts as one of pictures: test_recorder.py -k however_many
pebble/recordings/recorder/open_files.py
- return lane if lane == STATE or lane in self._files
+ return lane if lane in self._files

a new file begins without the retained values: test_recorder.py -k begins_with_the_retained
pebble/recordings/recorder/open_files.py
- for value in self.retained.carried():
+ for value in ():

an emptied value is carried on: test_recorder.py -k begins_with_the_retained
pebble/recordings/recorder/open_files.py
- self._values.pop(key, None)
+ pass

an old retained value replaces a newer one: test_recorder.py -k carried_values_are
pebble/recordings/recorder/open_files.py
- if item.retained and known is not None and not known.retained:
+ if False:

brokers share their retained values: test_recorder.py -k carried_values_are
pebble/recordings/recorder/open_files.py
- key = f"{item.source} {item.topic}"
+ key = f" {item.topic}"

what was fetched anew is not forgotten: test_recorder.py -k carried_values_are
pebble/recordings/recorder/open_files.py
- del self._values[key]
+ pass

files are never rotated: test_recorder.py -k begins_with_the_retained
pebble/recordings/recorder/writing.py
- if all_of_them or old or idle or
+ if all_of_them or

a large file is not rotated: test_recorder.py -k however_many
pebble/recordings/recorder/writing.py
-  or file.writer.size > self._options.rotate_bytes:
+ :

what a full disk has not taken is lost: test_recorder.py -k full_disk
pebble/recordings/recorder/writing.py
- self._lacking += file.take_lacking()
+ file.take_lacking()

what a full disk has taken is written twice: test_recorder.py -k full_disk
pebble/recordings/recorder/lane.py
- return items[max(0, len(items) - lacking) :] if lacking else []
+ return items

a gap has no count: test_recorder.py -k full_disk or cannot_be_opened
pebble/recordings/recorder/writing.py
- messages=dropped - blocked.dropped)
+ messages=0)

events of a gap are lost: test_recorder.py -k full_disk
pebble/recordings/recorder/writing.py
- self._intake.put_back(item)
+ pass

what no file took is not counted at the end: test_recorder.py -k counted_at_the_end
pebble/recordings/recorder/writing.py
- self._intake.drop(len(self._lacking))
+ self._intake.drop(0)

a file that is left is not finished: test_recorder.py -k full_disk or killed
pebble/recordings/recorder/finisher.py
- self._background.do(partial(self._mend, path))
+ pass

state goes before pictures: test_disk_space.py
pebble/recordings/recorder/disk_space.py
- return media[:-1] + state[:-1]
+ return state[:-1] + media[:-1]

files of others are deleted, too: test_recorder.py -k oldest_media
pebble/recordings/recorder/folder.py
- if match is not None and stat.S_ISREG(about.st_mode):
-                 found.append(Entry(path, int(match["number"]), match["lane"], about.st_size, about.st_mtime))
+ if stat.S_ISREG(about.st_mode):
+                 number, lane = (match["number"], match["lane"]) if match else (0, "media.x")
+                 found.append(Entry(path, int(number), lane, about.st_size, about.st_mtime))

nothing is deleted: test_disk_space.py
pebble/recordings/recorder/disk_space.py
- too_much = limits.keep_bytes and used > limits.keep_bytes
+ too_much = False

no file is too old: test_disk_space.py
pebble/recordings/recorder/disk_space.py
- if days and now - entry.ended > days * _DAY_S:
+ if False:

files that are too old go all at once: test_recorder.py -k one_in_a_minute
pebble/recordings/recorder/writing.py
- if due.every("age", _AGE_S):
-             old = outdated(entries, limits, now_s)
-             if old is not None:
-                 self._delete(old.path, old.size)
+ while (old := outdated(entries, limits, now_s)) is not None:
+                 self._delete(old.path, old.size)
+                 entries.remove(old)

a removed file is written on: test_recorder.py -k folder_that_is_removed
pebble/recordings/recorder/writing.py
- if not file.is_there():
+ if False:

a folder on another disk is not followed: test_recorder.py -k costs_what_comes_meanwhile
pebble/recordings/recorder/writing.py
- if self._folder.in_place:
-             return
+ return

it writes until the disk is full: test_recorder.py -k no_room
pebble/recordings/recorder/writing.py
- if disk.free_bytes < limits.free_bytes // 2 or not disk.has_inodes:
+ if False:

it does not write on when there is room again: test_recorder.py -k full_disk or cannot_be_opened
pebble/recordings/recorder/writing.py
- elif self._blocked is not None and (disk.free_bytes >= limits.free_bytes or not self._blocked.full):
+ elif False:

a second recorder may write: test_recorder.py -k one_recorder
pebble/recordings/recorder/folder.py
- fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
+ pass

a clock that was set is followed slowly: test_recorder.py -k jump
pebble/recordings/recorder/clock.py
- if abs(difference) > _JUMP_NS:
+ if False:

a clock that was set begins no file: test_recorder.py -k jump
pebble/recordings/recorder/recorder.py
- self._writing.flush()
-             self._writing.rotate(all_of_them=True)
+ pass

time goes back in a file: test_recorder.py -k goes_back
pebble/recordings/recorder/lane.py
- self.last_ns = log_ns = max(self.last_ns, at_ns)
+ self.last_ns = log_ns = at_ns

a suspended machine leaves no gap: test_recorder.py -k suspended
pebble/recordings/recorder/recorder.py
- if suspended_s > _LATE_S:
+ if False:

nothing is made durable: test_recorder.py -k power
pebble/recordings/recorder/background.py
- os.fdatasync(descriptor)
+ pass

a bad message ends the recording: test_recorder.py -k no_payload
pebble/recordings/recorder/lane.py
- stamp = stamp_ns(item.payload)
+ stamp = int(__import__("json").loads(item.payload or b"0").get("t", 0))

topics of a stranger have channels without bound: test_recorder.py -k stranger
pebble/recordings/files/channels.py
- _MOST, _MOST_OF_ONE = 4096, 512
+ _MOST, _MOST_OF_ONE = 1 << 30, 1 << 30

an outage is no gap: test_record.py -k outage
pebble/recordings/recorder/source.py
- if self._lost_at:
+ if False:

retained messages are not fetched: test_record.py -k byte_for_byte or mqtt_3
pebble/recordings/recorder/source.py
- self._wants_copies = self._kind == "mqtt"
+ self._wants_copies = False

what two filters match is recorded twice: test_record.py -k byte_for_byte
pebble/recordings/recorder/source.py
- if not any(matches(filter_, message.topic) for filter_ in earlier):
+ if True:

a replay is recorded again: test_record.py -k byte_for_byte
pebble/recordings/recorder/source.py
- () if any(one.startswith(REPLAYED) for one in self._filters) else (REPLAYED,)
+ ()
"""

if __name__ == "__main__":
    sys.exit(main(MUTATIONS, "tests/recordings/recorder"))
