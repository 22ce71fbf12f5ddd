// The floor of a drive command: two C programs in the place of a robot's bridge and of its serial line.
// floor bridge LOCAL_PORT REMOTE_PORT BASE DEVICE, floor serial …: `cc floor.c -lmosquitto`.
#include <fcntl.h>
#include <mosquitto.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

enum { HEARTBEAT_MS = 250, STATUS_EVERY = 4, TEXT = 256 };

typedef void (*receive_t)(struct mosquitto *, void *, const struct mosquitto_message *);

static struct mosquitto *open_client(const char *port, receive_t receive, void *to, const char *filter) {
  struct mosquitto *client = mosquitto_new(NULL, true, to);
  mosquitto_int_option(client, MOSQ_OPT_TCP_NODELAY, 1);
  mosquitto_message_callback_set(client, receive);
  if (mosquitto_connect(client, "127.0.0.1", atoi(port), 60) != MOSQ_ERR_SUCCESS) exit(1);
  mosquitto_subscribe(client, NULL, filter, 1);
  return client;
}

static void say(struct mosquitto *client, const char *base, const char *metric, const char *text) {
  char topic[TEXT];
  snprintf(topic, sizeof topic, "%s/outgoing/%s", base, metric);
  mosquitto_publish(client, NULL, topic, (int)strlen(text), text, 1, true);
}

static long now_ms(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return now.tv_sec * 1000 + now.tv_nsec / 1000000;
}

// Serves two clients, or one and a device, for at most `wait_ms`, on this thread alone; true if the device has said more.
static bool serve(struct mosquitto *first, struct mosquitto *second, int device, int wait_ms) {
  struct mosquitto *clients[] = {first, second};
  struct pollfd sources[] = {{mosquitto_socket(first), POLLIN, 0},
                             {second ? mosquitto_socket(second) : device, POLLIN, 0}};
  poll(sources, 2, wait_ms);
  for (int at = 0; at < 2 && clients[at]; at++) {
    if (sources[at].revents && mosquitto_loop_read(clients[at], 1) != MOSQ_ERR_SUCCESS) exit(1);
    if (mosquitto_want_write(clients[at])) mosquitto_loop_write(clients[at], 1);
    mosquitto_loop_misc(clients[at]);
  }
  return !second && sources[1].revents;
}

static void forward(struct mosquitto *from, void *to, const struct mosquitto_message *message) {
  (void)from;
  struct mosquitto **other = to;
  mosquitto_publish(*other, NULL, message->topic, message->payloadlen, message->payload, message->qos, message->retain);
}

static double axis(const char *text, const char *name) {
  const char *at = strstr(text, name);
  return at ? strtod(at + strlen(name), NULL) : 0.0;
}

static double within(double speed) { return speed > 1 ? 1 : speed < -1 ? -1 : speed; }

static void drive(struct mosquitto *from, void *device, const struct mosquitto_message *message) {
  (void)from;
  char text[TEXT];
  snprintf(text, sizeof text, "%.*s", message->payloadlen, (const char *)message->payload);
  double x = axis(text, "\"x\":"), z = axis(text, "\"z\":");
  dprintf(*(int *)device, "M %.3f %.3f\n", within(z + x), within(z - x));
}

_Noreturn static void bridge(const char *local_port, const char *remote_port, const char *base) {
  struct mosquitto *local = NULL, *remote = NULL;
  char incoming[TEXT], outgoing[TEXT];
  snprintf(incoming, sizeof incoming, "%s/incoming/#", base);
  snprintf(outgoing, sizeof outgoing, "%s/outgoing/#", base);
  remote = open_client(remote_port, forward, &local, incoming);
  local = open_client(local_port, forward, &remote, outgoing);
  for (int number = 0;; number++) {
    if (number % STATUS_EVERY == 0) say(remote, base, "status", "{\"value\":{\"services\":{\"c\":{\"state\":\"ready\"}}}}");
    say(remote, base, "online", "{\"t\":1}");
    for (long due = now_ms() + HEARTBEAT_MS, left; (left = due - now_ms()) > 0;) serve(local, remote, -1, (int)left);
  }
}

static int serial(const char *local_port, const char *base, const char *path) {
  int device = open(path, O_RDWR | O_NOCTTY);
  struct termios line;
  if (device < 0 || tcgetattr(device, &line) != 0) return 1;
  cfmakeraw(&line);
  cfsetspeed(&line, B460800);
  tcsetattr(device, TCSANOW, &line);
  char topic[TEXT], text[TEXT];
  snprintf(topic, sizeof topic, "%s/incoming/drive-values", base);
  struct mosquitto *local = open_client(local_port, drive, &device, topic);
  snprintf(topic, sizeof topic, "%s/outgoing/touch-sensors", base);
  for (int used = 0, a, b, c;;) {
    if (!serve(local, NULL, device, HEARTBEAT_MS)) continue;
    char piece[TEXT];
    ssize_t size = read(device, piece, sizeof piece);
    if (size <= 0) return 1;
    for (ssize_t at = 0; at < size; at++) {
      text[used] = piece[at] == '\n' ? 0 : piece[at];
      used = text[used] && used < TEXT - 2 ? used + 1 : 0;
      if (used > 0 || sscanf(text, "T a0=%d a1=%d a2=%d", &a, &b, &c) != 3) continue;
      char report[TEXT];
      int length = snprintf(report, sizeof report, "{\"value\":{\"a0\":%d,\"a1\":%d,\"a2\":%d}}", a, b, c);
      mosquitto_publish(local, NULL, topic, length, report, 1, false);
    }
  }
}

int main(int count, char **words) {
  if (count < 6 || mosquitto_lib_init() != MOSQ_ERR_SUCCESS) return 2;
  if (strcmp(words[1], "bridge") == 0) bridge(words[2], words[3], words[4]);
  return serial(words[2], words[4], words[5]);
}
