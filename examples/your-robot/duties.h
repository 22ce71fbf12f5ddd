// What a robot owes those who drive it, see docs/your-robot.md.
#pragma once
#include "control.h"
#include "emergency_stop.h"

static const char *const OWNER = "motors";  // the name of what commands the motors
static const int DEAD_MAN_MS = 750;         // the longest time for which a command counts
static const int PAUSE_MS = 500;            // after a reset: until no command came for so long, or a zero of the driver
static const int HEARTBEAT_MS = 250;

class Robot {
public:
    virtual void turn(double left, double right, int for_ms) = 0;               // command the motors, -1..1
    virtual void publish(const String &metric, const JsonDocument &value) = 0;  // retained

    // named: commands need an account.
    void begin(bool is_named) {
        named = is_named;
        stop.begin(named);
    }

    // Publish everything again: the broker may be another one.
    void connected() { stop.is_new = control.is_new = wheels_are_new = true; }

    void halt() { move(0, 0, 0); }

    // Take one message below incoming/, of a person's account or of none.
    void receive(const String &metric, const String &account, const uint8_t *payload, unsigned size) {
        JsonDocument message;
        JsonVariantConst command = command_of(message, payload, size);
        bool is_command = command.is<JsonObjectConst>();
        bool is_known = account.length() > 0 || !named;
        int changes = control.changes;
        if (metric == "estop" && size > 0) {
            halt();
            stop.press(command, account);
        } else if (metric == "drive-values" && is_command) {
            drive(command, account);
        } else if (metric == "estop-reset" && is_command && is_known) {
            if (stop.reset(command)) paused_until = now_ms() + PAUSE_MS;
        } else if ((metric == "control" || metric == "control/take") && is_command && is_known) {
            control.request(command, account, metric == "control/take");
        }
        if (control.changes != changes) halt();  // the next driver must not get a robot that moves
    }

    // Call it often: it ends what is over, and publishes what has changed.
    void tick() {
        int changes = control.changes;
        control.tick();
        if (now_ms() >= wheels_until || control.changes != changes) halt();
        if (wheels_are_new) {
            wheels_are_new = false;
            JsonDocument status;
            status["t"] = epoch_ms();
            status["value"]["wheels"].add(left);
            status["value"]["wheels"].add(right);
            publish("status", status);
        }
        if (control.is_new) {
            control.is_new = false;
            JsonDocument state;
            control.write(state);
            state["named"] = named;
            state["boot"] = stop.boot;
            publish(String("control/") + OWNER, state);
        }
        if (stop.is_new) {
            stop.is_new = false;
            if (!stop.is_saved) {
                stop.save();
                paused_until = now_ms() + PAUSE_MS;  // what has come meanwhile moves nothing
            }
            JsonDocument state;
            stop.write(state);
            publish(String("estop/") + OWNER, state);
        }
        if (now_ms() >= heartbeat_at) {
            heartbeat_at = now_ms() + HEARTBEAT_MS;
            JsonDocument heartbeat;
            heartbeat["t"] = epoch_ms();
            publish("online", heartbeat);
        }
    }

private:
    void drive(JsonVariantConst command, const String &account) {
        double x = number_of(command["x"], 0);  // steers, to the right if positive
        double z = number_of(command["z"], 0);  // drives, ahead if positive
        double valid_ms = number_of(command["valid_ms"], DEAD_MAN_MS);
        if (!std::isfinite(x) || !std::isfinite(z) || !std::isfinite(valid_ms)) return;  // NaN may become full speed
        x = constrain(x, -1, 1);
        z = constrain(z, -1, 1);
        bool by_holder = control.is_held_by(text_of(command["key"]), account);
        bool keyless = command["key"].isUnbound() && !named;
        if (by_holder) control.renew();
        if (x == 0 && z == 0) {
            halt();  // a zero needs no key
            if (by_holder || control.is_free()) paused_until = 0;  // the driver has let go
        } else if (now_ms() < paused_until) {
            paused_until = now_ms() + PAUSE_MS;  // a stick that is held down since the stop moves nothing
        } else if (!stop.latched && (by_holder || keyless)) {
            move(constrain(z + x, -1, 1), constrain(z - x, -1, 1), constrain(valid_ms, 0, DEAD_MAN_MS));
        }
    }

    void move(double to_left, double to_right, int for_ms) {
        wheels_are_new = wheels_are_new || to_left != left || to_right != right;
        left = to_left;
        right = to_right;
        wheels_until = now_ms() + for_ms;
        turn(left, right, for_ms);
    }

    EmergencyStop stop;
    Control control;
    bool named = false, wheels_are_new = true;
    double left = 0, right = 0;
    int64_t wheels_until = 0, paused_until = 0, heartbeat_at = 0;
};
