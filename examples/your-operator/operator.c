// The smallest honest operator, with libmosquitto and cJSON:  operator ID HOST PORT [USER PASSWORD_FILE CA_FILE]
// Each line of standard input is a command: "0 0.5" steers by 0 and drives at 0.5 until the next line, "0 0" lets go,
// "stop" and "reset" are the emergency stop; at its end control is released. With a user its commands bear this name.
#define _GNU_SOURCE  // gcc -o operator operator.c -lmosquitto -lcjson -lm
#include <cjson/cJSON.h>
#include <math.h>
#include <mosquitto.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
#define CLAMP(value, least, most) fmax(least, fmin(most, value))
static const double LETS_GO_S = 3, REPEATS_S = 0.5, GIVES_UP_S = 60;
enum { OWNERS = 16 };
#define EACH(one) for (struct owner *one = owners; one < owners + OWNERS; one++)
static struct mosquitto *client; static cJSON *capabilities;
static char id[9], in[256], plain[128], out[128], topic[320], text[512], password[128], *by = "sample";
static double x, z, seen = -INFINITY, drives_at, asks_at, moved_at = -INFINITY;
static int moves, blocked, offline = 1;  // blocked: until the stick is let go
static struct link { char level[8]; double drive_hz; } link_ = {"wide", 20};
static struct owner { char name[33]; cJSON *stop, *control; } owners[OWNERS];  // of motors, by name
static struct { char name[17]; double at, end; } pressed;  // an emergency stop that is not confirmed, and when it is repeated
static double now(void) { struct timespec t; clock_gettime(CLOCK_MONOTONIC, &t); return t.tv_sec + t.tv_nsec / 1e9; }  // never set
static void hex8(char *to) { unsigned n; if (getentropy(&n, sizeof n)) abort(); sprintf(to, "%08x", n); }
static const cJSON *get(const cJSON *of, const char *name) { return cJSON_GetObjectItemCaseSensitive(of, name); }
static const char *string(const cJSON *item) {  // what JSON escapes is in none of them
    return cJSON_IsString(item) && !strpbrk(item->valuestring, "\"\\\n\t") ? item->valuestring : "";
}
static int by_name(const void *a, const void *b) { return strcmp(((struct owner *)a)->name, ((struct owner *)b)->name); }
static void publish(const char *base, const char *metric, int qos) {
    snprintf(topic, sizeof topic, "%s%s", base, metric), mosquitto_publish(client, NULL, topic, strlen(text), text, qos, false);
}
#define send(metric, qos, ...) (snprintf(text, sizeof text, __VA_ARGS__), publish(in, metric, qos))
static struct owner *owner(const char *name) {  // NULL: there is no room for one more
    EACH(one) if (!strcmp(one->name, name)) return one;
    struct owner *empty = *name ? owner("") : NULL;
    if (empty) strcpy(empty->name, name), qsort(owners, OWNERS, sizeof *owners, by_name);
    return empty ? owner(name) : NULL;
}
static int pushed(void) { return x != 0 || z != 0; }  static int wide(void) { return !strcmp(link_.level, "wide"); }
static int controlled(void) { return cJSON_IsTrue(get(get(capabilities, "drive"), "control")); }
static const char *key(void) {  // the keys of all owners; the first owner by name decides who drives
    static char keys[256];
    *keys = 0;
    EACH(one) if (one->control) {
        const char *own = strcmp(string(get(one->control, "id")), id) ? "" : string(get(one->control, "key"));
        if (!*own && !*keys) break;
        if (*own && strlen(keys) + strlen(own) + 2 < sizeof keys) strcat(strcat(keys, *keys ? " " : ""), own);
    }
    return keys;
}
static const char *why_not(void) {  // why nothing may move; empty if it may
    if (offline || now() > seen + (wide() ? 1.5 : strcmp(link_.level, "thin") ? 3 : 5)) return "the robot is silent";
    EACH(one) if (one->stop && !cJSON_IsFalse(get(one->stop, "latched"))) return "the robot is stopped";
    return *pressed.name ? "the robot is stopped" : blocked ? "let go first" : "";
}
static void push(double to_x, double to_z) {  // the stick is here now; what is no number lets it go
    int numbers = isfinite(to_x) && isfinite(to_z);
    x = numbers ? CLAMP(to_x, -1, 1) : 0, z = numbers ? CLAMP(to_z, -1, 1) : 0;
    if (pushed()) return;
    blocked = moves = 0, send("drive-values", 1, *key() ? "{\"x\": 0, \"z\": 0, \"key\": \"%s\"}" : "{\"x\": 0, \"z\": 0}", key());
}
static void request(const char *want) {
    char stamp[40] = ""; if (!wide()) sprintf(stamp, ", \"t\": %.0f", floor(1000 * now()));
    send("control", 1, "{\"id\": \"%s\", \"want\": \"%s\", \"for_ms\": %d, \"by\": \"%s\", \"device\": \"sample\"%s}", id, want,
         wide() ? 3000 : 10000, by, stamp);
}
static void forget_control(void) { EACH(one) cJSON_Delete(one->control), one->control = NULL; }
static void drive(void) {  // often enough for the wheels to turn on, and no more often than the link carries
    if (pushed() && (*why_not() || (moves && controlled() && !*key()))) blocked = 1, moves = 0;  // a held stick must not drive on later
    if (pushed() && !*why_not()) moved_at = now();
    if (controlled() && now() >= asks_at && now() < moved_at + LETS_GO_S) asks_at = now() + 1, request("hold");
    else if (*key() && now() > moved_at + LETS_GO_S) request("release"), forget_control();
    if (!pushed() || *why_not() || (controlled() && !*key()) || now() < drives_at) return;
    char stamp[300] = "";
    if (*key()) snprintf(stamp, sizeof stamp, ", \"key\": \"%s\", \"t\": %.0f", key(), floor(1000 * now()));
    drives_at = fmax(drives_at, now() - 0.1) + 1 / CLAMP(link_.drive_hz, 2, 20), moves = 1;
    send("drive-values", wide(), "{\"x\": %.4f, \"z\": %.4f, \"valid_ms\": %d%s}", x, z, wide() ? 400 : 750, stamp);
}
static int has_stop(const struct owner *one) {
    const cJSON *name;
    cJSON_ArrayForEach(name, get(one ? one->stop : NULL, "recent")) if (!strcmp(string(name), pressed.name)) return 1;
    return 0;
}
static void repeat_stop(void) {  // until every owner has its name, or a minute has gone by
    const cJSON *listed = get(get(capabilities, "estop"), "owners"), *name;
    int all = 0, have = 0;
    cJSON_ArrayForEach(name, listed) all++, have += strlen(string(name)) < sizeof owners->name && has_stop(owner(string(name)));
    EACH(one) if (!listed && one->stop) all++, have += has_stop(one);
    if ((all && have == all) || now() > pressed.end) return (void)(*pressed.name = 0);
    if (now() < pressed.at) return;
    pressed.at = now() + REPEATS_S, snprintf(text, sizeof text, "{\"stop\": \"%s\", \"by\": \"%s\"}", pressed.name, by);
    publish(plain, "estop", 1);  // a stop needs no name
    if (strcmp(plain, in)) publish(in, "estop", 1);
}
static void reset(void) {  // ends the stops that are shown now, and no later one
    EACH(one) if (cJSON_IsNumber(get(one->stop, "count")))
        send("estop-reset", 1, "{\"boot\": \"%s\", \"count\": %.0f}", string(get(one->stop, "boot")), get(one->stop, "count")->valuedouble);
}
static void receive(struct mosquitto *, void *, const struct mosquitto_message *message) {
    char name[33] = "", *metric = message->topic + strlen(out);
    cJSON *value = cJSON_ParseWithLength(message->payload, message->payloadlen), **kept = NULL;
    if (!strcmp(metric, "online") && !message->retain && value) seen = now(), offline = cJSON_IsFalse(get(value, "online"));
    if (!strcmp(metric, "capabilities")) cJSON_Delete(capabilities), capabilities = cJSON_DetachItemFromObject(value, "value");
    if (!strcmp(metric, "link")) link_ = (struct link){"wide", 20};
    if (!strcmp(metric, "link") && cJSON_IsNumber(get(value, "drive_hz")))
        link_.drive_hz = get(value, "drive_hz")->valuedouble, snprintf(link_.level, sizeof link_.level, "%s", string(get(value, "level")));
    struct owner *of = sscanf(metric, "estop/%32[^/]", name) == 1 || sscanf(metric, "control/%32[^/]", name) == 1 ? owner(name) : NULL;
    if (of) kept = *metric == 'e' ? &of->stop : &of->control;
    if (*metric == 'c' && *string(get(value, "asks"))) printf("%s asks for control\n", string(get(value, "asks"))), fflush(stdout);
    if (kept && cJSON_IsObject(value)) cJSON_Delete(*kept), *kept = value; else cJSON_Delete(value);
}
static void connected(struct mosquitto *, void *, int) {
    const char *const METRICS[] = {"online", "capabilities", "link", "estop/+", "control/+"};
    for (int i = 0; i < 5; i++) snprintf(topic, sizeof topic, "%s%s", out, METRICS[i]), mosquitto_subscribe(client, NULL, topic, 1);
}
static void line(const char *of) {
    double to_x = 0, to_z = 0;
    if (!strcmp(of, "stop")) hex8(pressed.name), hex8(pressed.name + 8), pressed.at = now(), pressed.end = now() + GIVES_UP_S;
    else if (!strcmp(of, "reset")) reset();
    else if (sscanf(of, "%lf %lf", &to_x, &to_z) != 0) push(to_x, to_z);
}
int main(int argc, char **argv) {
    if (argc != 4 && argc != 7) return fputs("operator ID HOST PORT [USER PASSWORD_FILE CA_FILE]\n", stderr), 2;
    char lines[256] = "";
    FILE *file = argc == 7 ? fopen(argv[5], "r") : NULL;
    if (argc == 7 && !(file && fscanf(file, "%127[^\n]", password) == 1)) return perror(argv[5]), 1;
    snprintf(plain, sizeof plain, "pebble/robots/%s/incoming/", argv[1]), snprintf(out, sizeof out, "pebble/robots/%s/outgoing/", argv[1]);
    by = argc == 7 ? argv[4] : by, hex8(id), snprintf(in, sizeof in, "%s%s%s%s", plain, file ? "by/" : "", file ? by : "", file ? "/" : "");
    mosquitto_lib_init(), client = mosquitto_new(NULL, true, NULL);
    if (file) mosquitto_username_pw_set(client, by, password), mosquitto_tls_set(client, argv[6], NULL, NULL, NULL, NULL);
    mosquitto_connect_callback_set(client, connected), mosquitto_message_callback_set(client, receive);
    mosquitto_connect(client, argv[2], atoi(argv[3]), 5);
    for (struct pollfd person = {.events = POLLIN};;) {
        if (mosquitto_loop(client, 10, 1) != MOSQ_ERR_SUCCESS) offline = 1, forget_control(), usleep(200000), mosquitto_reconnect(client);
        if (poll(&person, 1, 0) > 0) {
            size_t size = strlen(lines) % (sizeof lines - 1);  // a line that fills it is none
            ssize_t more = read(0, lines + size, sizeof lines - 1 - size);
            if (more <= 0) break;
            lines[size + more] = 0;
            for (char *end; (end = strchr(lines, '\n')); memmove(lines, end + 1, strlen(end + 1) + 1)) *end = 0, line(lines);
        }
        drive();
        if (*pressed.name) repeat_stop();
    }
    push(0, 0), request("release");
    for (double end = now() + 0.3; now() < end;) mosquitto_loop(client, 10, 1);
}
