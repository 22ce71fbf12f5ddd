// The floor of a drive command: two C programs with libmosquitto in the place of a robot's bridge and of its motor owner.
// floor bridge|serial LOCAL_PORT REMOTE_PORT BASE DEVICE
#include <fcntl.h>
#include <mosquitto.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <unistd.h>

enum { STEP_MS = 50, STATUS_EVERY = 4, TEXT = 256 };

static struct mosquitto *source, *target;  // of the brokers from which commands come, and to which the bridge sends them
static int device;

static struct mosquitto *connected(const char *port) {
  struct mosquitto *client = mosquitto_new(NULL, true, NULL);
  mosquitto_int_option(client, MOSQ_OPT_TCP_NODELAY, 1);
  if (mosquitto_connect(client, "127.0.0.1", atoi(port), 60) != MOSQ_ERR_SUCCESS) exit(1);
  return client;
}

static void forward(struct mosquitto *client, void *data, const struct mosquitto_message *message) {
  (void)client, (void)data;
  mosquitto_publish(target, NULL, message->topic, message->payloadlen, message->payload, message->qos, false);
}

static double axis(const char *text, const char *name) {
  const char *at = strstr(text, name);
  return at ? strtod(at + strlen(name), NULL) : 0.0;
}

static void drive(struct mosquitto *client, void *data, const struct mosquitto_message *message) {
  (void)client, (void)data;
  char text[TEXT];
  snprintf(text, sizeof text, "%.*s", message->payloadlen, (const char *)message->payload);
  double x = axis(text, "\"x\":"), z = axis(text, "\"z\":");
  dprintf(device, "M %.3f %.3f\n", z + x, z - x);
}

static void say(const char *base, const char *metric, const char *text) {
  char topic[TEXT];
  snprintf(topic, sizeof topic, "%s/outgoing/%s", base, metric);
  mosquitto_publish(source, NULL, topic, (int)strlen(text), text, 0, true);  // a PUBACK would delay a command
}

static void serve(struct mosquitto *client, short found) {
  if (found && mosquitto_loop_read(client, 1) != MOSQ_ERR_SUCCESS) exit(1);
  if (mosquitto_want_write(client)) mosquitto_loop_write(client, 1);
  mosquitto_loop_misc(client);
}

int main(int count, char **words) {
  if (count < 6 || mosquitto_lib_init() != MOSQ_ERR_SUCCESS) return 2;
  int bridges = strcmp(words[1], "bridge") == 0;
  char filter[TEXT];
  struct termios line;
  snprintf(filter, sizeof filter, "%s/incoming/%s", words[4], bridges ? "#" : "drive-values");
  source = connected(words[bridges ? 3 : 2]);
  mosquitto_message_callback_set(source, bridges ? forward : drive);
  mosquitto_subscribe(source, NULL, filter, 1);
  if (bridges) {
    target = connected(words[2]);
  } else if ((device = open(words[5], O_RDWR | O_NOCTTY)) < 0 || tcgetattr(device, &line) != 0) {
    return 1;
  } else {
    cfmakeraw(&line);
    tcsetattr(device, TCSANOW, &line);
  }
  for (int step = 0;; step++) {
    struct pollfd sockets[] = {{mosquitto_socket(source), POLLIN, 0}, {bridges ? mosquitto_socket(target) : -1, POLLIN, 0}};
    poll(sockets, 2, STEP_MS);
    serve(source, sockets[0].revents);
    if (!bridges) continue;
    serve(target, sockets[1].revents);
    if (step % STATUS_EVERY) continue;
    say(words[4], "online", "{\"t\":1}");
    say(words[4], "status", "{\"value\":{\"services\":{\"floor\":{\"state\":\"ready\"}}}}");
  }
}
