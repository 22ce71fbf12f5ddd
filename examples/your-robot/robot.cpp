// The smallest honest robot, for Arduino on an ESP32, with PubSubClient and ArduinoJson. Your settings.h has WIFI, WIFI_PASSWORD,
// ID, HOST, PORT, USER, PASSWORD and CA. Without a name, USER is nullptr; with one, only what has the sender's account moves it, or ends a stop.
#include <ArduinoJson.h>
#include <Preferences.h>
#include <PubSubClient.h>
#include <Ticker.h>
#include <WiFiClientSecure.h>
#include "settings.h"
#define SMALL "abcdefghijklmnopqrstuvwxyz0123456789_/-"
#define TEXT SMALL " ABCDEFGHIJKLMNOPQRSTUVWXYZ.,:;!?@#+*()='"  // nothing that JSON escapes
static const char *const BOOL[] = {"false", "true"};
static const double DEAD_MAN_S = 0.75, PAUSE_S = 0.5;
enum { LONGEST = 512, RECENT = 8, VERSION = 1 };
struct Stop { int version = VERSION, latched = 0; char recent[RECENT][17] = {}, by[34] = "", why[41] = ""; double since = 0; };
struct Driver { char id[9] = "", by[75] = "", device[21] = "", key[9] = "", account[33] = ""; double holds_s = 0, ends = 0; };
static struct { enum { FIRST, LENGTH, BODY } at; uint32_t left; int shift; bool retain; } packet;  // the one that is being read
template <class Link> struct Watched : Link {  // PubSubClient does not pass on the retain flag: it is in the first byte of a packet
    int read() override {
        int one = Link::read();
        if (one < 0) return one;
        if (packet.at == packet.FIRST) packet = {packet.LENGTH, 0, 0, (one & 1) != 0};
        else if (packet.at == packet.BODY) packet.at = --packet.left ? packet.BODY : packet.FIRST;
        else if (packet.left |= (one & 127) << packet.shift, packet.shift += 7, one < 128) packet.at = packet.left ? packet.BODY : packet.FIRST;
        return one;
    }
};
static Watched<WiFiClient> plain; static Watched<WiFiClientSecure> secure;
static PubSubClient mqtt; static Preferences flash; static Ticker dead_man;
static int named, count, shown, saved;  // shown: what the wheels do has been published
static const char *refused = "null";
static char boot[9], topic[160], text[1024];
static double paused_at = -INFINITY, until, left, right, sign_at;  // when the wheels stop, and what they do
static Stop stop; static Driver holder, asker;  // who drives, who waits
static double now() { return esp_timer_get_time() / 1e6; }
static double epoch_ms() { timespec t; clock_gettime(CLOCK_REALTIME, &t); return 1e3 * t.tv_sec + t.tv_nsec / 1000000; }
static void hex8(char *to) { snprintf(to, 9, "%08x", (unsigned)esp_random()); }
static bool same(JsonVariantConst item, const char *text) { return !strcmp(item | "", text); }
static double number(JsonVariantConst item, double none) { return item.isUnbound() ? none : item.is<double>() ? item.as<double>() : NAN; }
static size_t copy(char *to, size_t room, const char *from, const char *allowed) {  // returns how much of it is allowed
    snprintf(to, room, "%s", from);
    for (char *at = to; *(at += strspn(at, allowed));) *at = '_';
    return strspn(from, allowed);
}
static void publish_text(const char *metric) {  // with QoS 0: PubSubClient has no other
    snprintf(topic, sizeof topic, "pebble/robots/%s/outgoing/%s", ID, metric), mqtt.publish(topic, text, true);
}
#define publish(metric, ...) (snprintf(text, sizeof text, __VA_ARGS__), publish_text(metric))
static void publish_stop() {  // and save it
    char names[RECENT * 21] = "";
    for (int i = 0; i < RECENT && *stop.recent[i]; i++) sprintf(names + strlen(names), "%s\"%s\"", i ? ", " : "", stop.recent[i]);
    if (!saved) saved = flash.putBytes("stop", &stop, sizeof stop) == sizeof stop, paused_at = now();  // what came meanwhile moves nothing
    publish("estop/motors", "{\"latched\": %s, \"recent\": [%s], \"by\": \"%s\", \"why\": \"%s\", \"since\": %.0f, \"boot\": \"%s\", "
            "\"count\": %d, \"reset_refused\": %s, \"persisted\": %s}", BOOL[stop.latched], names, stop.by, stop.why, stop.since,
            boot, count, refused, BOOL[saved]);
}
static void load_stop() {  // what cannot be read is a stop
    bool there = !flash.begin("pebble") || flash.isKey("stop");
    bool whole = there && flash.getBytes("stop", &stop, sizeof stop) == sizeof stop && stop.version == VERSION;
    if (there && !whole) stop = Stop(), stop.latched = 1;
}
static void pins(double, double) {}  // set yours here
static void turn(double to_left, double to_right, double for_s) {
    shown = shown && to_left == left && to_right == right, left = to_left, right = to_right, until = now() + for_s;
    pins(left, right);
    if (for_s > 0) dead_man.once_ms(1000 * for_s, [] { pins(0, 0); });  // even while loop() waits for the network
    if (!shown) publish("status", "{\"t\": %.0f, \"value\": {\"wheels\": [%.3f, %.3f]}}", epoch_ms(), left, right);
    shown = true;
}
static void drive(JsonVariantConst command, const char *account) {
    double x = number(command["x"], 0), z = number(command["z"], 0), valid_s = number(command["valid_ms"], 750) / 1000;
    if (!std::isfinite(x) || !std::isfinite(z) || !std::isfinite(valid_s)) return;  // NaN is no number
    bool mine = *holder.key && same(command["key"], holder.key) && !strcmp(account, holder.account);
    x = constrain(x, -1, 1), z = constrain(z, -1, 1);
    if (mine) holder.ends = fmax(holder.ends, now() + holder.holds_s);
    if (x == 0 && z == 0 && (mine || !*holder.key)) paused_at = -INFINITY;  // who lets go after a reset may drive again
    if (x == 0 && z == 0) return turn(0, 0, 0);
    if (now() < paused_at + PAUSE_S) return (void)(paused_at = now());  // a stick that is held down moves nothing
    if (stop.latched || !(mine || (command["key"].isUnbound() && !named))) return;
    turn(constrain(z + x, -1, 1), constrain(z - x, -1, 1), constrain(valid_s, 0, DEAD_MAN_S));
}
static void halt(JsonVariantConst told, const char *account) {  // whatever arrives is a stop; what has a name counts once
    char name[18]; turn(0, 0, 0);
    if (copy(name, sizeof name, told["stop"] | "", "0123456789abcdef") != 16 || name[16]) hex8(name), hex8(name + 8);
    for (auto &one : stop.recent) if (!strcmp(one, name)) return publish_stop();
    memmove(stop.recent[1], stop.recent[0], sizeof stop.recent - sizeof stop.recent[0]), strcpy(stop.recent[0], name);
    copy(stop.by, 32, told["by"] | "", TEXT), copy(stop.why, sizeof stop.why, told["why"] | "", TEXT);
    if (*account) strcpy(stop.by, account); else if (named) strcat(stop.by, "?");  // "?": no broker has checked it
    stop.latched = 1, stop.since = epoch_ms(), count++, refused = "null", saved = 0, publish_stop();
}
static void reset(JsonVariantConst command) {  // ends the stop that its sender has seen, and no other
    refused = !same(command["boot"], boot) ? "\"boot\"" : number(command["count"], NAN) == count ? "null" : "\"count\"";
    if (!strcmp(refused, "null") && stop.latched) stop.latched = saved = 0;
    publish_stop();
}
static void publish_control() {
    publish("control/motors", "{\"id\": \"%s\", \"by\": \"%s\", \"device\": \"%s\", \"key\": \"%s\", \"asks\": \"%s\", \"asks_id\": \"%s\", "
            "\"named\": %s, \"boot\": \"%s\"}", holder.id, holder.by, holder.device, holder.key, asker.by, asker.id, BOOL[named], boot);
}
static void pass_on(const Driver &to) { holder = to, asker = Driver(), turn(0, 0, 0), publish_control(); }
static void control(JsonVariantConst command, const char *account, bool take) {  // until it ends, is released or taken
    Driver fresh; char name[41];
    double for_s = number(command["for_ms"], 3000) / 1000;
    if (copy(fresh.id, 9, command["id"] | "", "0123456789abcdefABCDEF") != 8 || !std::isfinite(for_s)) return;
    copy(name, sizeof name, command["by"] | "", SMALL), copy(fresh.device, sizeof fresh.device, command["device"] | "", SMALL);
    snprintf(fresh.by, sizeof fresh.by, "%s%s%s", account, *account && *name ? "/" : "", name), strcpy(fresh.account, account);
    hex8(fresh.key), fresh.holds_s = constrain(for_s, 1, 10), fresh.ends = now() + fresh.holds_s;
    bool mine = !strcmp(fresh.id, holder.id) && !strcmp(account, holder.account), release = same(command["want"], "release");
    if (release ? mine : !mine && (take || !*holder.key)) return pass_on(release ? Driver() : fresh);
    if (mine) holder.holds_s = fresh.holds_s, holder.ends = fresh.ends;
    else if (!release && (!*asker.id || !strcmp(asker.id, fresh.id))) asker = fresh;
    publish_control();
}
static void receive(char *full, uint8_t *payload, unsigned int size) {  // both are in the buffer that the next publish overwrites
    char account[33] = "", *metric = strstr(full, "/incoming/") + strlen("/incoming/");
    if (packet.retain) return;  // a kept command is stale
    if (sscanf(metric, "by/%32[^/]", account) == 1) metric = strchr(metric + 3, '/') + 1;
    JsonDocument whole; deserializeJson(whole, payload, size <= LONGEST ? size : 0);
    JsonVariantConst inner = whole["value"], value = inner.is<JsonObjectConst>() ? inner : JsonVariantConst(whole);
    if (!strcmp(metric, "estop")) return size > 0 ? halt(value, account) : void();
    if (!strcmp(metric, "drive-values") && value.is<JsonObjectConst>()) return drive(value, account);
    if (named && !*account) return;
    if (!strcmp(metric, "estop-reset")) reset(value);
    else if (!strcmp(metric, "control") || !strcmp(metric, "control/take")) control(value, account, strlen(metric) > strlen("control"));
}
static void connect() {  // which may take seconds
    turn(0, 0, 0), packet = {}, shown = false;
    snprintf(topic, sizeof topic, "pebble/robots/%s/outgoing/online", ID);
    snprintf(text, sizeof text, "{\"t\": %.0f, \"online\": false}", epoch_ms());
    if (!mqtt.connect((std::string("robot-") + ID).c_str(), USER, PASSWORD, topic, 1, true, text)) return delay(200);
    snprintf(topic, sizeof topic, "pebble/robots/%s/incoming/#", ID), mqtt.subscribe(topic, 0);  // it acknowledges nothing that is too long
    publish("capabilities", "{\"t\": %.0f, \"schema\": \"pebble-capabilities/v1\", \"value\": {\"named\": %s, "
            "\"identity\": {\"system\": \"pebble\", \"type\": \"robots\", \"id\": \"%s\"}, \"drive\": {\"available\": true, \"controls\": true, "
            "\"control\": true}, \"estop\": {\"available\": true, \"owners\": [\"motors\"]}}}", epoch_ms(), BOOL[named], ID);
    publish_stop(), publish_control(), turn(0, 0, 0);
}
void setup() {
    hex8(boot), load_stop(), named = USER != nullptr;
    for (WiFi.begin(WIFI, WIFI_PASSWORD); WiFi.status() != WL_CONNECTED;) delay(100);
    for (configTime(0, 0, "pool.ntp.org"); time(nullptr) < 1700000000;) delay(100);  // a certificate has a date, too
    if (named) secure.setCACert(CA), mqtt.setClient(secure); else mqtt.setClient(plain);
    mqtt.setServer(HOST, PORT), mqtt.setCallback(receive), mqtt.setKeepAlive(5), mqtt.setSocketTimeout(2), mqtt.setBufferSize(1024);
}
void loop() {
    if (!mqtt.loop()) connect();
    if (now() >= until) turn(0, 0, 0);
    if (*holder.key && now() > holder.ends) pass_on(Driver());
    if (*asker.id && now() > asker.ends) asker = Driver(), publish_control();
    if (now() >= sign_at) sign_at = now() + 0.25, publish("online", "{\"t\": %.0f}", epoch_ms());
    delay(1);
}
