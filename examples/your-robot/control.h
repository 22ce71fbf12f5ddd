// Who drives a robot: one has control until it ends, is released or is taken; one who asks meanwhile is shown.
// No command with another key than its holder's moves the robot; at level open one without a key still does.
#pragma once
#include "payloads.h"

class Control {
public:
    int changes = 0;     // how often control was given, or ended
    bool is_new = true;  // to be published

    bool is_free() const { return key.length() == 0; }

    bool is_held_by(const String &other_key, const String &other_account) const {
        return !is_free() && other_key == key && other_account == account;
    }

    // Prolong it: its holder has sent a command.
    void renew() {
        ends_at = max(ends_at, now_ms() + for_ms);
    }

    // Give it to the first who asks, to its holder again, or to the one who takes it.
    void request(JsonVariantConst command, const String &sender, bool take) {
        String own_id = text_of(command["id"]);
        double wanted_ms = number_of(command["for_ms"], 3000);
        if (!is_hex(own_id, 8) || !std::isfinite(wanted_ms)) return;
        int64_t lasts_ms = constrain(wanted_ms, 1000, 10000);
        String name = name_of(command["by"], 40);
        if (sender.length() > 0 && name.length() > 0) name = sender + "/" + name;
        else if (sender.length() > 0) name = sender;
        bool is_holder = !is_free() && own_id == id && sender == account;
        if (text_of(command["want"]) == "release") {
            if (is_holder) pass_to("", "", "", "");
        } else if (is_holder || take || is_free()) {
            if (!is_holder) pass_to(own_id, name.substring(0, 40), name_of(command["device"], 20), new_hex(8));
            account = sender;
            for_ms = lasts_ms;
            ends_at = now_ms() + lasts_ms;
        } else if (asks_id.length() == 0 || asks_id == own_id) {
            asks = name.substring(0, 40);
            asks_id = own_id;
            asks_until = now_ms() + lasts_ms;
            is_new = true;
        }
    }

    // End what is over.
    void tick() {
        if (!is_free() && now_ms() > ends_at) pass_to("", "", "", "");
        if (asks_id.length() > 0 && now_ms() > asks_until) {
            asks = asks_id = "";
            is_new = true;
        }
    }

    // What is published: outgoing/control/OWNER.
    void write(JsonDocument &state) const {
        state["id"] = id;
        state["by"] = by;
        state["device"] = device;
        state["key"] = key;
        state["asks"] = asks;
        state["asks_id"] = asks_id;
    }

private:
    void pass_to(const String &to_id, const String &to_by, const String &to_device, const String &to_key) {
        id = to_id;
        by = to_by;
        device = to_device;
        key = to_key;
        asks = asks_id = "";
        changes++;
        is_new = true;
    }

    String id, by, device, key, account;  // of the holder; "" while there is none
    int64_t for_ms = 0, ends_at = 0;      // how long it lasts without a request or a command
    String asks, asks_id;                 // who waits for it
    int64_t asks_until = 0;
};
