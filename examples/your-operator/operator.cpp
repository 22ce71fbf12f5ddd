// The smallest honest operator, for Arduino on an ESP32, with PubSubClient and ArduinoJson. Your settings.h has WIFI, WIFI_PASSWORD,
// ID, HOST, PORT, USER, PASSWORD and CA; USER is nullptr, or its commands bear this name. Lines of the serial console are commands: "0 0.5"
// steers by 0 and drives at 0.5 until the next line, "0 0" lets go, "stop" and "reset" are the emergency stop, "end" releases control.
#include <ArduinoJson.h>
#include <PubSubClient.h>
#include <WiFiClientSecure.h>
#include "settings.h"
static const double LETS_GO_S = 3, REPEATS_S = 0.5, GIVES_UP_S = 60;  enum { OWNERS = 16 };
struct Owner {  // of motors: what its states tell
    char name[33] = "", boot[33] = "", id[9] = "", key[33] = "";
    double count = 0; bool listed = false, stops = false, latched = false, confirms = false, controls = false;
};
static Owner owners[OWNERS];  // by name
static WiFiClient plain_link; static WiFiClientSecure secure_link; static Client *link_; static PubSubClient mqtt;
static char id[9], in[160], plain[128], out[128], topic[256], text[512], line[64], level[8] = "wide";
static double x, z, drive_hz = 20, heartbeat, seen = -INFINITY, drives_at, asks_at, moved_at = -INFINITY;
static bool moves, blocked, offline = true, controlled;  // blocked: until the stick is let go
static struct { char name[17]; double at, end; } pressed;  // an emergency stop that is not confirmed, and when it is repeated
static double now() { return esp_timer_get_time() / 1e6; }  // of a clock that is never set
static const char *by() { return USER ? USER : "sample"; }
static void hex8(char *to) { snprintf(to, 9, "%08x", (unsigned)esp_random()); }
static double number(JsonVariantConst item, double none) { return item.is<double>() ? item.as<double>() : none; }
static bool yes(JsonVariantConst item) { return item.is<bool>() && item.as<bool>(); }
static void publish_text(const char *base, const char *metric, int qos) {  // PubSubClient has QoS 0 only: this is written beside it
    static uint16_t packets;
    uint8_t packet[sizeof topic + sizeof text + 8];
    size_t name = snprintf(topic, sizeof topic, "%s%s", base, metric), left = 2 + name + (qos ? 2 : 0) + strlen(text), at = 0;
    packet[at++] = 0x30 | qos << 1, packet[at++] = left < 128 ? left : (left & 127) | 128, packets = packets % 65535 + 1;
    if (left >= 128) packet[at++] = left >> 7;
    packet[at++] = name >> 8, packet[at++] = name & 255, memcpy(packet + at, topic, name), at += name;
    if (qos) packet[at++] = packets >> 8, packet[at++] = packets & 255;
    memcpy(packet + at, text, strlen(text));
    if (mqtt.connected()) link_->write(packet, at + strlen(text));
}
#define publish(base, metric, qos, ...) (snprintf(text, sizeof text, __VA_ARGS__), publish_text(base, metric, qos))
static int by_name(const void *a, const void *b) { return strcmp(((Owner *)a)->name, ((Owner *)b)->name); }
static Owner *owner(const char *name) {  // nullptr: there is no room for one more
    for (Owner &one : owners) if (!strcmp(one.name, name)) return &one;
    Owner *empty = *name && strlen(name) < sizeof owners->name ? owner("") : nullptr;
    return empty ? strcpy(empty->name, name), qsort(owners, OWNERS, sizeof *owners, by_name), owner(name) : nullptr;
}
static bool pushed() { return x != 0 || z != 0; }  static bool wide() { return !strcmp(level, "wide"); }
static const char *key() {  // the keys of all owners; the first owner by name decides who drives
    static char keys[256];
    *keys = 0;
    for (Owner &one : owners) if (one.controls) {
        bool own = !strcmp(one.id, id) && *one.key;
        if (!own && !*keys) break;
        if (own && strlen(keys) + sizeof one.key + 1 < sizeof keys) strcat(strcat(keys, *keys ? " " : ""), one.key);
    }
    return keys;
}
static const char *why_not() {  // why nothing may move; empty if it may
    if (offline || now() > seen + (wide() ? 1.5 : strcmp(level, "thin") ? 3 : 5)) return "the robot is silent";
    for (Owner &one : owners) if (one.stops && one.latched) return "the robot is stopped";
    return *pressed.name ? "the robot is stopped" : blocked ? "let go first" : "";
}
static void push(double to_x, double to_z) {  // the stick is here now; what is no number lets it go
    bool numbers = std::isfinite(to_x) && std::isfinite(to_z);
    x = numbers ? constrain(to_x, -1, 1) : 0, z = numbers ? constrain(to_z, -1, 1) : 0;
    if (pushed()) return;
    blocked = moves = false, publish(in, "drive-values", 1, *key() ? "{\"x\": 0, \"z\": 0, \"key\": \"%s\"}" : "{\"x\": 0, \"z\": 0}", key());
}
static void request(const char *want) {
    char stamp[40] = ""; if (!wide()) snprintf(stamp, sizeof stamp, ", \"t\": %.0f", floor(1000 * now()));
    publish(in, "control", 1, "{\"id\": \"%s\", \"want\": \"%s\", \"for_ms\": %d, \"by\": \"%s\", \"device\": \"sample\"%s}", id, want,
            wide() ? 3000 : 10000, by(), stamp);
}
static void forget_control() { for (Owner &one : owners) one.controls = false; }
static void drive() {  // often enough for the wheels to turn on, and no more often than the link carries
    if (pushed() && (*why_not() || (moves && controlled && !*key()))) blocked = true, moves = false;  // a held stick must not drive on later
    if (pushed() && !*why_not()) moved_at = now();
    if (controlled && now() >= asks_at && now() < moved_at + LETS_GO_S) asks_at = now() + 1, request("hold");
    else if (*key() && now() > moved_at + LETS_GO_S) request("release"), forget_control();
    if (!pushed() || *why_not() || (controlled && !*key()) || now() < drives_at) return;
    char stamp[300] = "";
    if (*key()) snprintf(stamp, sizeof stamp, ", \"key\": \"%s\", \"t\": %.0f", key(), floor(1000 * now()));
    drives_at = fmax(drives_at, now() - 0.1) + 1 / constrain(drive_hz, 2.0, 20.0), moves = true;
    publish(in, "drive-values", wide(), "{\"x\": %.4f, \"z\": %.4f, \"valid_ms\": %d%s}", x, z, wide() ? 400 : 750, stamp);
}
static void repeat_stop() {  // until every owner has its name, or a minute has gone by
    int listed = 0, all = 0, have = 0;
    for (Owner &one : owners) listed += one.listed;
    for (Owner &one : owners) if (listed ? one.listed : one.stops) all++, have += one.confirms;
    if ((all && have == all) || now() > pressed.end) return (void)(*pressed.name = 0);
    if (now() < pressed.at) return;
    pressed.at = now() + REPEATS_S, publish(plain, "estop", 1, "{\"stop\": \"%s\", \"by\": \"%s\"}", pressed.name, by());  // it needs no name
    if (strcmp(plain, in)) publish_text(in, "estop", 1);
}
static void reset() {  // ends the stops that are shown now, and no later one
    for (Owner &one : owners) if (one.stops) publish(in, "estop-reset", 1, "{\"boot\": \"%s\", \"count\": %.0f}", one.boot, one.count);
}
static void receive(char *full, uint8_t *payload, unsigned int size) {
    char *metric = full + strlen(out), *name = strchr(metric, '/');
    JsonDocument whole; deserializeJson(whole, payload, size);
    JsonVariantConst value = whole, told = value["value"];
    double t = number(value["t"], 0); bool gone = value["online"].is<bool>() && !yes(value["online"]);
    if (!strcmp(metric, "online") && (gone || (t != heartbeat && heartbeat))) seen = now(), offline = gone;
    if (!strcmp(metric, "online")) heartbeat = t;  // the first may be retained, which PubSubClient does not tell
    if (!strcmp(metric, "link")) snprintf(level, sizeof level, "%s", value["level"] | "wide"), drive_hz = number(value["drive_hz"], 20);
    else if (!strcmp(metric, "capabilities")) {
        controlled = yes(told["drive"]["control"]);
        for (Owner &one : owners) one.listed = false;
        for (JsonVariantConst one : told["estop"]["owners"].as<JsonArrayConst>()) if (Owner *of = owner(one | "")) of->listed = true;
    }
    Owner *of = name ? owner(name + 1) : nullptr;
    if (!of || !value.is<JsonObjectConst>()) return;
    if (!strncmp(metric, "estop/", 6)) {
        snprintf(of->boot, sizeof of->boot, "%s", value["boot"] | ""), of->count = number(value["count"], 0);
        of->stops = true, of->latched = !value["latched"].is<bool>() || yes(value["latched"]);
        for (JsonVariantConst one : value["recent"].as<JsonArrayConst>()) of->confirms |= !strcmp(one | "", pressed.name);
    } else {
        snprintf(of->id, sizeof of->id, "%s", value["id"] | ""), snprintf(of->key, sizeof of->key, "%s", value["key"] | "");
        of->controls = true; if (*(value["asks"] | "")) Serial.printf("%s asks for control\n", value["asks"] | "");
    }
}
static void connect() {
    static const char *const METRICS[] = {"online", "capabilities", "link", "estop/+", "control/+"};
    offline = true, heartbeat = 0, forget_control();
    if (!mqtt.connect((std::string("operator-") + id).c_str(), USER, PASSWORD)) return delay(200);
    for (const char *one : METRICS) snprintf(topic, sizeof topic, "%s%s", out, one), mqtt.subscribe(topic, 0);  // as the robot does
}
static void command() {
    double to_x = 0, to_z = 0;
    if (!strcmp(line, "stop")) {
        for (Owner &one : owners) one.confirms = false;
        hex8(pressed.name), hex8(pressed.name + 8), pressed.at = now(), pressed.end = now() + GIVES_UP_S;
    }
    else if (!strcmp(line, "reset")) reset();
    else if (!strcmp(line, "end")) push(0, 0), request("release"), moved_at = -INFINITY;
    else if (sscanf(line, "%lf %lf", &to_x, &to_z) > 0) push(to_x, to_z);
}
void setup() {
    Serial.begin(115200), hex8(id), link_ = USER ? &secure_link : &plain_link, secure_link.setCACert(CA);
    snprintf(plain, sizeof plain, "pebble/robots/%s/incoming/", ID), snprintf(out, sizeof out, "pebble/robots/%s/outgoing/", ID);
    snprintf(in, sizeof in, "%s%s%s%s", plain, USER ? "by/" : "", USER ? USER : "", USER ? "/" : "");
    for (WiFi.begin(WIFI, WIFI_PASSWORD); WiFi.status() != WL_CONNECTED;) delay(100);
    for (configTime(0, 0, "pool.ntp.org"); time(nullptr) < 1700000000;) delay(100);  // a certificate has a date, too
    mqtt.setClient(*link_), mqtt.setServer(HOST, PORT), mqtt.setCallback(receive), mqtt.setKeepAlive(5), mqtt.setSocketTimeout(2), mqtt.setBufferSize(2048);
}
void loop() {
    if (!mqtt.loop()) connect();
    while (Serial.available()) {
        size_t size = strlen(line); char one = Serial.read();
        if (one == '\n') command(), *line = 0; else if (size < sizeof line - 1) line[size] = one, line[size + 1] = 0;
    }
    drive();
    if (*pressed.name) repeat_stop();
    delay(1);
}
