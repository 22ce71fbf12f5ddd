// The smallest honest robot, with libmosquitto and cJSON:  robot ID HOST PORT STOP_FILE [USER PASSWORD_FILE CA_FILE]
// With a user it is at level named: only what has the sender's account in its topic moves it, or ends a stop.
#define _GNU_SOURCE  // gcc -o robot robot.c -lmosquitto -lcjson -lm
#include <cjson/cJSON.h>
#include <errno.h>
#include <math.h>
#include <mosquitto.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <time.h>
#include <unistd.h>
#define CLAMP(value, least, most) fmax(least, fmin(most, value))
#define SMALL "abcdefghijklmnopqrstuvwxyz0123456789_/-"
#define TEXT SMALL " ABCDEFGHIJKLMNOPQRSTUVWXYZ.,:;!?@#+*()='"  // nothing that JSON escapes
static const char *const BOOL[] = {"false", "true"};
static const double DEAD_MAN_S = 0.75, PAUSE_S = 0.5;
static const int LONGEST = 512, RECENT = 8;
static struct mosquitto *client;
static const char *stop_file, *refused = "null";
static char base[64], boot[9];
static int named, online, count;
static double paused_at = -INFINITY, until, left, right;  // when the wheels stop, and what they do
static struct { int latched; char recent[8][17], by[34], why[41]; double since; } stop;
static struct { char id[9], by[75], device[21], key[9], account[33]; double holds_s, ends; } holder;  // who drives
static double clock_s(clockid_t id) { struct timespec t; clock_gettime(id, &t); return t.tv_sec + t.tv_nsec / 1e9; }
static double now(void) { return clock_s(CLOCK_MONOTONIC); }
static double epoch_ms(void) { return 1000 * clock_s(CLOCK_REALTIME); }
static void hex8(char *to) { unsigned n; if (getrandom(&n, sizeof n, 0) < 0) abort(); sprintf(to, "%08x", n); }
static const cJSON *get(const cJSON *of, const char *name) { return cJSON_GetObjectItemCaseSensitive(of, name); }
static int same(const cJSON *item, const char *text) { return cJSON_IsString(item) && !strcmp(item->valuestring, text); }
static void copy(char *to, size_t room, const cJSON *from, const char *allowed) {
    const char *text = cJSON_IsString(from) ? from->valuestring : "";
    for (; *text && room > 1; text++, room--) *to++ = strchr(allowed, *text) ? *text : '_';
    *to = 0;
}
static int number(const cJSON *of, const char *name, double *value) {  // NaN is no number
    const cJSON *item = get(of, name);
    if (item) *value = cJSON_IsNumber(item) ? item->valuedouble : NAN;
    return isfinite(*value);
}
static void publish(const char *metric, int qos, const char *format, ...) {
    char topic[128], text[1024];
    va_list values;
    va_start(values, format), vsnprintf(text, sizeof text, format, values), va_end(values);
    snprintf(topic, sizeof topic, "%s/outgoing/%s", base, metric);
    if (online) mosquitto_publish(client, NULL, topic, strlen(text), text, qos, true);
}
static void publish_stop(void) {
    char text[512], names[200] = "", temporary[512];
    for (int i = 0; i < RECENT && *stop.recent[i]; i++)
        sprintf(names + strlen(names), "%s\"%s\"", i ? ", " : "", stop.recent[i]);
    snprintf(text, sizeof text, "\"latched\": %s, \"recent\": [%s], \"by\": \"%s\", \"why\": \"%s\", \"since\": %.0f",
             BOOL[stop.latched], names, stop.by, stop.why, stop.since);
    snprintf(temporary, sizeof temporary, "%s.new", stop_file);
    FILE *file = fopen(temporary, "w");
    int saved = file && fprintf(file, "{%s}", text) > 0 && fflush(file) == 0 && fsync(fileno(file)) == 0;
    if (file) saved = fclose(file) == 0 && saved && rename(temporary, stop_file) == 0;
    publish("estop/motors", 1, "{%s, \"boot\": \"%s\", \"count\": %d, \"reset_refused\": %s, \"persisted\": %s}", text, boot,
            count, refused, BOOL[saved]);
}
static void load_stop(void) {
    char text[1024] = "";
    FILE *file = fopen(stop_file, "r");
    if (!file && errno == ENOENT) return;
    if (file) text[fread(text, 1, sizeof text - 1, file)] = 0, fclose(file);
    cJSON *state = cJSON_Parse(text);  // what cannot be read is a stop
    stop.latched = !cJSON_IsFalse(get(state, "latched")), number(state, "since", &stop.since);
    for (int i = 0; i < RECENT; i++) copy(stop.recent[i], 17, cJSON_GetArrayItem(get(state, "recent"), i), SMALL);
    copy(stop.by, sizeof stop.by, get(state, "by"), TEXT), copy(stop.why, sizeof stop.why, get(state, "why"), TEXT);
    cJSON_Delete(state);
}
static void publish_wheels(void) {
    publish("status", 1, "{\"t\": %.0f, \"value\": {\"wheels\": [%.3f, %.3f]}}", epoch_ms(), left, right);
}
static void turn(double to_left, double to_right, double for_s) {  // set your pins here, and for so long
    int changed = to_left != left || to_right != right;
    left = to_left, right = to_right, until = now() + for_s;
    if (changed) publish_wheels();
}
static void drive(const cJSON *command, const char *account) {
    double x = 0, z = 0, valid_ms = 1000 * DEAD_MAN_S;
    if (!number(command, "x", &x) || !number(command, "z", &z) || !number(command, "valid_ms", &valid_ms)) return;
    const cJSON *key = get(command, "key");
    int mine = *holder.key && same(key, holder.key) && !strcmp(account, holder.account);
    x = CLAMP(x, -1, 1), z = CLAMP(z, -1, 1);
    if (x == 0 && z == 0) {
        turn(0, 0, 0);
        if (mine || !*holder.key) paused_at = -INFINITY;  // who lets go after a reset may drive again
    } else if (now() < paused_at + PAUSE_S) {
        paused_at = now();  // a stick that is held down moves nothing
    } else if (!stop.latched && (mine || (!key && !named))) {
        if (mine) holder.ends = fmax(holder.ends, now() + holder.holds_s);
        turn(CLAMP(z + x, -1, 1), CLAMP(z - x, -1, 1), CLAMP(valid_ms / 1000, 0, DEAD_MAN_S));
    }
}
static void halt(const cJSON *told, const char *account) {  // whatever arrives is a stop; what has a name counts once
    char name[18];
    turn(0, 0, 0), copy(name, sizeof name, get(told, "stop"), "0123456789abcdef");
    if (strlen(name) != 16 || strchr(name, '_')) hex8(name), hex8(name + 8);
    for (int i = 0; i < RECENT; i++) if (!strcmp(stop.recent[i], name)) return publish_stop();
    memmove(stop.recent[1], stop.recent[0], sizeof stop.recent - sizeof stop.recent[0]), strcpy(stop.recent[0], name);
    copy(stop.by, 32, get(told, "by"), TEXT), copy(stop.why, sizeof stop.why, get(told, "why"), TEXT);
    if (*account) strcpy(stop.by, account); else if (named) strcat(stop.by, "?");  // "?": no broker has checked it
    stop.latched = 1, stop.since = epoch_ms(), count++, refused = "null", publish_stop();
}
static void reset(const cJSON *command) {  // ends the stop that its sender has seen, and no other
    double counted = -1;
    refused = !same(get(command, "boot"), boot) ? "\"boot\"" : !number(command, "count", &counted) || counted != count ? "\"count\"" : "null";
    if (!strcmp(refused, "null") && stop.latched) stop.latched = 0, paused_at = now();
    publish_stop();
}
static void pass_on(void) { memset(&holder, 0, sizeof holder), turn(0, 0, 0); }
static void publish_control(void) {
    publish("control/motors", 1, "{\"id\": \"%s\", \"by\": \"%s\", \"device\": \"%s\", \"key\": \"%s\", \"named\": %s, \"boot\": \"%s\"}",
            holder.id, holder.by, holder.device, holder.key, BOOL[named], boot);
}
static void control(const cJSON *command, const char *account, int take) {  // until it ends, is released or taken
    char id[10], who[41];
    double for_ms = 3000;
    copy(id, sizeof id, get(command, "id"), "0123456789abcdefABCDEF"), copy(who, sizeof who, get(command, "by"), SMALL);
    if (strlen(id) != 8 || strchr(id, '_') || !number(command, "for_ms", &for_ms)) return;
    int mine = !strcmp(id, holder.id) && !strcmp(account, holder.account), release = same(get(command, "want"), "release");
    if (mine && release) pass_on();
    if (!release && !mine && (take || !*holder.key)) {
        pass_on(), hex8(holder.key), strcpy(holder.id, id), strcpy(holder.account, account), mine = 1;
        snprintf(holder.by, sizeof holder.by, "%s%s%s", account, *account && *who ? "/" : "", who);
        copy(holder.device, sizeof holder.device, get(command, "device"), SMALL);
    }
    if (!release && mine) holder.holds_s = CLAMP(for_ms / 1000, 1, 10), holder.ends = now() + holder.holds_s;
    publish_control();
}
static void receive(struct mosquitto *, void *, const struct mosquitto_message *message) {
    const char *metric = message->topic + strlen(base) + strlen("/incoming/");
    char account[33] = "";
    if (message->retain) return;  // a kept command is stale
    if (!strncmp(metric, "by/", 3)) {
        snprintf(account, sizeof account, "%.*s", (int)strcspn(metric + 3, "/"), metric + 3);
        metric = strchr(metric + 3, '/') + 1;
    }
    cJSON *whole = message->payloadlen <= LONGEST ? cJSON_ParseWithLength(message->payload, message->payloadlen) : NULL;
    const cJSON *value = cJSON_IsObject(get(whole, "value")) ? get(whole, "value") : whole;
    if (!strcmp(metric, "estop") && message->payloadlen > 0) halt(value, account);
    else if (cJSON_IsObject(value) && !strcmp(metric, "drive-values")) drive(value, account);
    else if (cJSON_IsObject(value) && (*account || !named)) {
        if (!strcmp(metric, "estop-reset")) reset(value);
        else if (!strncmp(metric, "control", 7)) control(value, account, !strcmp(metric, "control/take"));
    }
    cJSON_Delete(whole);
}
static void connected(struct mosquitto *, void *, int code) {
    static const char *metrics[] = {"estop", "estop-reset", "drive-values", "control", "control/take"};
    char topic[128];
    online = code == 0;
    for (int i = 0; online && i < 5 * (named + 1); i++) {
        snprintf(topic, sizeof topic, "%s/incoming/%s%s", base, i < 5 ? "" : "by/+/", metrics[i % 5]);
        mosquitto_subscribe(client, NULL, topic, 1);
    }
    publish("capabilities", 1, "{\"t\": %.0f, \"schema\": \"pebble-capabilities/v1\", \"value\": {\"named\": %s, "
            "\"identity\": {\"system\": \"pebble\", \"type\": \"robots\", \"id\": \"%s\"}, \"drive\": {\"available\": true, "
            "\"controls\": true, \"control\": true}, \"estop\": {\"available\": true, \"owners\": [\"motors\"]}}}",
            epoch_ms(), BOOL[named], strrchr(base, '/') + 1);
    publish_stop(), publish_control(), publish_wheels();
}
int main(int argc, char **argv) {
    if (argc != 5 && argc != 8) return fputs("robot ID HOST PORT STOP_FILE [USER PASSWORD_FILE CA_FILE]\n", stderr), 2;
    char topic[128], will[64], password[128] = "";
    snprintf(base, sizeof base, "pebble/robots/%s", argv[1]), hex8(boot), stop_file = argv[4], named = argc == 8, load_stop();
    mosquitto_lib_init(), client = mosquitto_new(NULL, true, NULL);
    FILE *file = named ? fopen(argv[6], "r") : NULL;
    if (named && !(file && fgets(password, sizeof password, file))) return perror(argv[6]), 1;
    password[strcspn(password, "\n")] = 0;
    if (named) mosquitto_username_pw_set(client, argv[5], password), mosquitto_tls_set(client, argv[7], NULL, NULL, NULL, NULL);
    snprintf(topic, sizeof topic, "%s/outgoing/online", base);
    snprintf(will, sizeof will, "{\"t\": %.0f, \"online\": false}", epoch_ms());
    mosquitto_will_set(client, topic, strlen(will), will, 1, true);
    mosquitto_connect_callback_set(client, connected), mosquitto_message_callback_set(client, receive);
    mosquitto_connect(client, argv[2], atoi(argv[3]), 5);
    for (double sign_at = 0;;) {
        if (mosquitto_loop(client, 20, 1) != MOSQ_ERR_SUCCESS)
            online = 0, turn(0, 0, 0), usleep(200000), mosquitto_reconnect(client);  // connecting may take a while
        if (now() >= until) turn(0, 0, 0);
        if (*holder.key && now() > holder.ends) pass_on(), publish_control();
        if (now() >= sign_at) sign_at = now() + 0.25, publish("online", 0, "{\"t\": %.0f}", epoch_ms());
    }
}
