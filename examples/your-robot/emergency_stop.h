// The emergency stop of a robot. It ends only by a reset of what a person has seen, also after a power cut.
#pragma once
#include <Preferences.h>
#include "payloads.h"

class EmergencyStop {
public:
    String boot;  // new at each start: a reset that was meant for an earlier one does nothing
    bool latched = false;
    bool is_saved = false;
    bool is_new = true;  // to be published

    void begin(bool is_named) {
        named = is_named;
        boot = new_hex(8);
        if (flash.begin("pebble") && !flash.isKey("stop")) return;  // there was no stop yet
        JsonDocument saved;
        String text = flash.getString("stop");
        bool is_read = !deserializeJson(saved, text.c_str(), text.length());
        latched = !is_read || (saved["latched"] | true);  // what cannot be read is a stop
        by = text_of(saved["by"]);
        why = text_of(saved["why"]);
        since = saved["since"] | since;
        for (int i = 0; i < REMEMBERED; i++) recent[i] = text_of(saved["recent"][i]);
    }

    // Stop, whatever the command says. One that is repeated under its name counts once.
    void press(JsonVariantConst command, const String &account) {
        String name = text_of(command["stop"]);
        if (!is_hex(name, 16)) name = new_hex(16);
        is_new = true;
        for (const String &known : recent) {
            if (known == name) return;
        }
        for (int i = REMEMBERED - 1; i > 0; i--) recent[i] = recent[i - 1];
        recent[0] = name;
        by = printable(command["by"], 31);
        if (account.length() > 0) by = account.substring(0, 32);
        else if (named) by += "?";  // no broker has checked this name
        why = printable(command["why"], 40);
        since = epoch_ms();
        count++;
        refused = nullptr;
        latched = true;
        is_saved = false;
    }

    // End the stop that the sender has seen, and no later one. True if it ends.
    bool reset(JsonVariantConst command) {
        is_new = true;
        refused = nullptr;
        if (text_of(command["boot"]) != boot) refused = "boot";
        else if (number_of(command["count"], NAN) != count) refused = "count";
        if (refused != nullptr || !latched) return false;
        latched = false;  // its name stays: a repetition that comes late must not stop again
        is_saved = false;
        return true;
    }

    void save() {
        JsonDocument saved;
        String text;
        write(saved);
        serializeJson(saved, text);
        is_saved = flash.putString("stop", text) > 0;
    }

    // What is published: outgoing/estop/OWNER.
    void write(JsonDocument &state) const {
        state["latched"] = latched;
        state["boot"] = boot;
        state["count"] = count;
        state["by"] = by;
        state["why"] = why;
        state["since"] = since;
        state["reset_refused"] = refused;
        state["persisted"] = is_saved;
        state["recent"].to<JsonArray>();
        for (const String &name : recent) {
            if (name.length() > 0) state["recent"].add(name);
        }
    }

private:
    static const int REMEMBERED = 8;  // names of stops
    Preferences flash;
    String recent[REMEMBERED], by, why;
    int64_t since = 0;
    int count = 0;  // of stops since the start
    const char *refused = nullptr;  // why the last reset did nothing: "boot" or "count"
    bool named = false;
};
