"""The emergency stop of a robot. Only a reset of exactly the stop that a person has seen ends it, not a power cut."""

import json

from payloads import PRINTABLE, is_hex, new_hex, only

REMEMBERED = 8  # names of stops


class EmergencyStop:
    """The stop of one motor owner. ``save(text)`` writes a text so that a power cut does not take it."""

    def __init__(self, saved, save, named):
        """Store the arguments. ``saved``: the text saved last; None: there was no stop yet."""
        self.boot = new_hex(8)  # new at each start: a reset that was meant for an earlier one does nothing
        self.count = 0  # of stops since the start
        self.refused = None  # why the last reset did nothing: "boot" or "count"
        self.stop = {"latched": False, "recent": [], "by": "", "why": "", "since": 0}
        self.is_saved = False
        self.is_new = True  # to be published
        self._save = save
        self._named = named  # commands need an account, which the broker checks
        if saved is not None:
            self.stop["latched"] = True  # what cannot be read is a stop
            try:
                self.stop.update(json.loads(saved))
            except (ValueError, TypeError):
                self.stop["why"] = "the saved state cannot be read"

    @property
    def latched(self):
        return self.stop["latched"]

    def press(self, command, account, epoch_ms):
        """Stop, whatever the command says. A stop that is repeated under its name counts once."""
        name = command.get("stop")
        if not is_hex(name, 16):
            name = new_hex(16)
        self.is_new = True  # also for a repeated stop: its sender may have missed the answer
        if name in self.stop["recent"]:
            return
        by = only(command.get("by"), PRINTABLE, 31)
        if account:
            by = account[:32]
        elif self._named:
            by += "?"  # no broker has checked this name
        why = only(command.get("why"), PRINTABLE, 40)
        recent = self.stop["recent"][: REMEMBERED - 1]
        recent.insert(0, name)
        self.stop = {"latched": True, "recent": recent, "by": by, "why": why, "since": epoch_ms}
        self.count += 1
        self.refused = None
        self.is_saved = False

    def reset(self, command):
        """End the stop that the sender has seen, and no later one; return True if it ends."""
        self.is_new = True
        self.refused = None
        if command.get("boot") != self.boot:
            self.refused = "boot"
        elif command.get("count") != self.count:
            self.refused = "count"
        elif self.latched:
            self.stop["latched"] = False  # its name stays: a repetition that comes late must not stop again
            self.is_saved = False
            return True
        return False

    def save(self):
        if self.is_saved:
            return
        try:
            self._save(json.dumps(self.stop))
            self.is_saved = True
        except OSError:
            self.is_saved = False  # which is published: people must not rely on it

    def state(self):
        """Return the state to publish: outgoing/estop/OWNER."""
        state = {"boot": self.boot, "count": self.count, "reset_refused": self.refused, "persisted": self.is_saved}
        state.update(self.stop)
        return state
