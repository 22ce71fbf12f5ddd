// The smallest honest robot, with libmosquitto and cJSON:  robot ID HOST PORT STOP_FILE [USER PASSWORD_FILE CA_FILE]
// With a user it is at level named: only what has the sender's account in its topic moves it, or ends a stop.
#define _GNU_SOURCE  // gcc -o robot robot.c -lmosquitto -lcjson -lm
#include <cjson/cJSON.h>
#include <math.h>
#include <mosquitto.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
#define CLAMP(value, least, most) fmax(least, fmin(most, value))
#define SMALL "abcdefghijklmnopqrstuvwxyz0123456789_/-"
#define TEXT SMALL " ABCDEFGHIJKLMNOPQRSTUVWXYZ.,:;!?@#+*()='"  // nothing that JSON escapes
static const char *const BOOL[] = {"false", "true"};
static const double DEAD_MAN_S = 0.75, PAUSE_S = 0.5;
enum { LONGEST = 512, RECENT = 8, VERSION = 1 };
static struct mosquitto *client;
static const char *id, *stop_file, *refused = "null";
static char boot[9], topic[128], text[1024], password[128];
static int named, online, count, shown, saved;  // shown: what the wheels do has been published
static double paused_at = -INFINITY, until, left, right;  // when the wheels stop, and what they do
static struct stop { int version, latched; char recent[RECENT][17], by[34], why[41]; double since; } stop = {.version = VERSION};
static struct client { char id[9], by[75], device[21], key[9], account[33]; double holds_s, ends; } holder, asker;  // who drives, who waits
static double clock_s(clockid_t of) { struct timespec t; clock_gettime(of, &t); return t.tv_sec + t.tv_nsec / 1e9; }
static double now(void) { return clock_s(CLOCK_MONOTONIC); }  static double epoch_ms(void) { return 1000 * clock_s(CLOCK_REALTIME); }
static void hex8(char *to) { unsigned n; if (getentropy(&n, sizeof n)) abort(); sprintf(to, "%08x", n); }
static const cJSON *get(const cJSON *of, const char *name) { return cJSON_GetObjectItemCaseSensitive(of, name); }
static int same(const cJSON *item, const char *text) { return cJSON_IsString(item) && !strcmp(item->valuestring, text); }
static size_t copy(char *to, size_t room, const cJSON *from, const char *allowed) {  // returns how much of it is allowed
    const char *text = cJSON_IsString(from) ? from->valuestring : "";
    snprintf(to, room, "%s", text);
    for (char *at = to; *(at += strspn(at, allowed));) *at = '_';
    return strspn(text, allowed);
}
static double number(const cJSON *item, double none) { return !item ? none : cJSON_IsNumber(item) ? item->valuedouble : NAN; }
static void publish_text(const char *metric, int qos) {
    snprintf(topic, sizeof topic, "pebble/robots/%s/outgoing/%s", id, metric);
    if (online) mosquitto_publish(client, NULL, topic, strlen(text), text, qos, true);
}
#define publish(metric, qos, ...) (snprintf(text, sizeof text, __VA_ARGS__), publish_text(metric, qos))
static void publish_stop(void) {  // and save it: in a new file that replaces the old one
    char names[RECENT * 21] = "", new[512];
    for (int i = 0; i < RECENT && *stop.recent[i]; i++) sprintf(names + strlen(names), "%s\"%s\"", i ? ", " : "", stop.recent[i]);
    snprintf(new, sizeof new, "%s.new", stop_file);
    if (!saved) mosquitto_loop_write(client, 1);  // shows that the wheels stand: saving may take a while
    FILE *file = saved ? NULL : fopen(new, "w");
    int whole = file && fwrite(&stop, sizeof stop, 1, file) == 1 && fflush(file) == 0 && fsync(fileno(file)) == 0;
    if (file) saved = fclose(file) == 0 && whole && rename(new, stop_file) == 0, paused_at = now();  // what came meanwhile moves nothing
    publish("estop/motors", 1, "{\"latched\": %s, \"recent\": [%s], \"by\": \"%s\", \"why\": \"%s\", \"since\": %.0f, \"boot\": \"%s\", "
            "\"count\": %d, \"reset_refused\": %s, \"persisted\": %s}", BOOL[stop.latched], names, stop.by, stop.why, stop.since,
            boot, count, refused, BOOL[saved]);
}
static void load_stop(void) {  // what cannot be read is a stop
    FILE *file = fopen(stop_file, "r");
    int there = file || access(stop_file, F_OK) == 0, whole = file && fread(&stop, sizeof stop, 1, file) == 1;
    if (there && !(whole && stop.version == VERSION)) stop = (struct stop){.version = VERSION, .latched = 1};
    if (file) fclose(file);
}
static void turn(double to_left, double to_right, double for_s) {  // set your pins here, and for so long
    shown = shown && to_left == left && to_right == right, left = to_left, right = to_right, until = now() + for_s;
    if (!shown) publish("status", 1, "{\"t\": %.0f, \"value\": {\"wheels\": [%.3f, %.3f]}}", epoch_ms(), left, right);
    shown = 1;
}
static void drive(const cJSON *command, const char *account) {
    double x = number(get(command, "x"), 0), z = number(get(command, "z"), 0), valid_s = number(get(command, "valid_ms"), 750) / 1000;
    if (!isfinite(x) || !isfinite(z) || !isfinite(valid_s)) return;  // NaN is no number
    int mine = *holder.key && same(get(command, "key"), holder.key) && !strcmp(account, holder.account);
    x = CLAMP(x, -1, 1), z = CLAMP(z, -1, 1);
    if (mine) holder.ends = fmax(holder.ends, now() + holder.holds_s);
    if (x == 0 && z == 0 && (mine || !*holder.key)) paused_at = -INFINITY;  // who lets go after a reset may drive again
    if (x == 0 && z == 0) return turn(0, 0, 0);
    if (now() < paused_at + PAUSE_S) return (void)(paused_at = now());  // a stick that is held down moves nothing
    if (stop.latched || !(mine || (!get(command, "key") && !named))) return;
    turn(CLAMP(z + x, -1, 1), CLAMP(z - x, -1, 1), CLAMP(valid_s, 0, DEAD_MAN_S));
}
static void halt(const cJSON *told, const char *account) {  // whatever arrives is a stop; what has a name counts once
    char name[18]; turn(0, 0, 0);
    if (copy(name, sizeof name, get(told, "stop"), "0123456789abcdef") != 16 || name[16]) hex8(name), hex8(name + 8);
    for (int i = 0; i < RECENT; i++) if (!strcmp(stop.recent[i], name)) return publish_stop();
    memmove(stop.recent[1], stop.recent[0], sizeof stop.recent - sizeof stop.recent[0]), strcpy(stop.recent[0], name);
    copy(stop.by, 32, get(told, "by"), TEXT), copy(stop.why, sizeof stop.why, get(told, "why"), TEXT);
    if (*account) strcpy(stop.by, account); else if (named) strcat(stop.by, "?");  // "?": no broker has checked it
    stop.latched = 1, stop.since = epoch_ms(), count++, refused = "null", saved = 0, publish_stop();
}
static void reset(const cJSON *command) {  // ends the stop that its sender has seen, and no other
    int seen = cJSON_GetNumberValue(get(command, "count")) == count;
    refused = !same(get(command, "boot"), boot) ? "\"boot\"" : seen ? "null" : "\"count\"";
    if (!strcmp(refused, "null") && stop.latched) stop.latched = saved = 0, paused_at = now();
    publish_stop();
}
static void publish_control(void) {
    publish("control/motors", 1, "{\"id\": \"%s\", \"by\": \"%s\", \"device\": \"%s\", \"key\": \"%s\", \"asks\": \"%s\", \"asks_id\": \"%s\", "
            "\"named\": %s, \"boot\": \"%s\"}", holder.id, holder.by, holder.device, holder.key, asker.by, asker.id, BOOL[named], boot);
}
static void pass_on(struct client to) { holder = to, asker = (struct client){0}, turn(0, 0, 0), publish_control(); }
static void control(const cJSON *command, const char *account, int take) {  // until it ends, is released or taken
    struct client new = {0};
    char name[41];
    double for_s = number(get(command, "for_ms"), 3000) / 1000;
    if (copy(new.id, 9, get(command, "id"), "0123456789abcdefABCDEF") != 8 || !isfinite(for_s)) return;
    copy(name, sizeof name, get(command, "by"), SMALL), copy(new.device, sizeof new.device, get(command, "device"), SMALL);
    snprintf(new.by, sizeof new.by, "%s%s%s", account, *account && *name ? "/" : "", name), strcpy(new.account, account);
    hex8(new.key), new.holds_s = CLAMP(for_s, 1, 10), new.ends = now() + new.holds_s;
    int mine = !strcmp(new.id, holder.id) && !strcmp(account, holder.account), release = same(get(command, "want"), "release");
    if (release ? mine : !mine && (take || !*holder.key)) return pass_on(release ? (struct client){0} : new);
    if (mine) holder.holds_s = new.holds_s, holder.ends = new.ends;
    else if (!release && (!*asker.id || !strcmp(asker.id, new.id))) asker = new;
    publish_control();
}
static void receive(struct mosquitto *, void *, const struct mosquitto_message *message) {
    char account[33] = "", *metric = strstr(message->topic, "/incoming/") + strlen("/incoming/");
    if (message->retain) return;  // a kept command is stale
    if (sscanf(metric, "by/%32[^/]", account) == 1) metric = strchr(metric + 3, '/') + 1;
    cJSON *whole = message->payloadlen <= LONGEST ? cJSON_ParseWithLength(message->payload, message->payloadlen) : NULL;
    const cJSON *value = cJSON_IsObject(get(whole, "value")) ? get(whole, "value") : whole;
    if (!strcmp(metric, "estop") && message->payloadlen > 0) halt(value, account);
    else if (!strcmp(metric, "drive-values") && cJSON_IsObject(value)) drive(value, account);
    else if (!strcmp(metric, "estop-reset") && (*account || !named)) reset(value);
    else if ((!strcmp(metric, "control") || !strcmp(metric, "control/take")) && (*account || !named)) control(value, account, !strcmp(metric, "control/take"));
    cJSON_Delete(whole);
}
static void connected(struct mosquitto *, void *, int code) {
    online = code == 0, shown = 0;
    snprintf(topic, sizeof topic, "pebble/robots/%s/incoming/#", id), mosquitto_subscribe(client, NULL, topic, 1);
    publish("capabilities", 1, "{\"t\": %.0f, \"schema\": \"pebble-capabilities/v1\", \"value\": {\"named\": %s, "
            "\"identity\": {\"system\": \"pebble\", \"type\": \"robots\", \"id\": \"%s\"}, \"drive\": {\"available\": true, \"controls\": true, "
            "\"control\": true}, \"estop\": {\"available\": true, \"owners\": [\"motors\"]}}}", epoch_ms(), BOOL[named], id);
    publish_stop(), publish_control();
}
int main(int argc, char **argv) {
    if (argc != 5 && argc != 8) return fputs("robot ID HOST PORT STOP_FILE [USER PASSWORD_FILE CA_FILE]\n", stderr), 2;
    id = argv[1], hex8(boot), stop_file = argv[4], named = argc == 8, load_stop();
    mosquitto_lib_init(), client = mosquitto_new(NULL, true, NULL);
    FILE *file = named ? fopen(argv[6], "r") : NULL;
    if (named && !(file && fscanf(file, "%127[^\n]", password) == 1)) return perror(argv[6]), 1;
    if (named) mosquitto_username_pw_set(client, argv[5], password), mosquitto_tls_set(client, argv[7], NULL, NULL, NULL, NULL);
    snprintf(topic, sizeof topic, "pebble/robots/%s/outgoing/online", id);
    mosquitto_will_set(client, topic, sprintf(text, "{\"t\": %.0f, \"online\": false}", epoch_ms()), text, 1, true);
    mosquitto_connect_callback_set(client, connected), mosquitto_message_callback_set(client, receive);
    mosquitto_connect(client, argv[2], atoi(argv[3]), 5);
    for (double sign_at = 0;;) {
        if (mosquitto_loop(client, 20, 1) != MOSQ_ERR_SUCCESS)
            online = 0, turn(0, 0, 0), usleep(200000), mosquitto_reconnect(client);  // connecting may take a while
        if (now() >= until) turn(0, 0, 0);
        if (*holder.key && now() > holder.ends) pass_on((struct client){0});
        if (*asker.id && now() > asker.ends) asker = (struct client){0}, publish_control();
        if (now() >= sign_at) sign_at = now() + 0.25, publish("online", 0, "{\"t\": %.0f}", epoch_ms());
    }
}
