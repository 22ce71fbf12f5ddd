// A robot for Arduino on an ESP32, with the libraries PubSubClient and ArduinoJson, and the headers beside it.
//
// Copy settings-example.h to settings.h, and write your own network, broker and account into it.
#include <PubSubClient.h>
#include <Ticker.h>
#include <WiFiClientSecure.h>
#include "duties.h"
#include "retain_flag.h"
#include "settings.h"

static RetainFlag retained;
static WatchedClient<WiFiClient> plain(retained);
static WatchedClient<WiFiClientSecure> secure(retained);
static PubSubClient mqtt;
static Ticker dead_man;

// Command your motors here, -1..1; a timer calls it too: be short, no Wire or Serial.
// It is called in every round while at rest: write to the hardware only on a change.
static void set_motors([[maybe_unused]] double left, [[maybe_unused]] double right) {}

static String topic_of(const String &metric) {
    return String("pebble/robots/") + ID + "/" + metric;
}

class MyRobot : public Robot {
public:
    // The timer stops the motors even while loop() waits for the network.
    void turn(double left, double right, int for_ms) override {
        set_motors(left, right);
        if (for_ms > 0) dead_man.once_ms(for_ms, [] { set_motors(0, 0); });
    }

    // With QoS 0, PubSubClient has no other: what is lost is published again at each connection.
    void publish(const String &metric, const JsonDocument &value) override {
        String text;
        serializeJson(value, text);
        mqtt.publish(topic_of("outgoing/" + metric).c_str(), text.c_str(), true);
    }
};

static MyRobot robot;

static void publish_capabilities() {
    JsonDocument message;
    message["t"] = epoch_ms();
    message["schema"] = "pebble-capabilities/v1";
    message["value"]["identity"]["system"] = "pebble";
    message["value"]["identity"]["type"] = "robots";
    message["value"]["identity"]["id"] = ID;
    message["value"]["drive"]["available"] = true;
    message["value"]["drive"]["controls"] = true;
    message["value"]["drive"]["control"] = true;
    message["value"]["estop"]["available"] = true;
    message["value"]["estop"]["owners"].add(OWNER);
    message["value"]["named"] = USER != nullptr;
    robot.publish("capabilities", message);
}

static void receive(char *topic, uint8_t *payload, unsigned int size) {
    if (retained.is_set) return;  // it is stale: it would be carried out at every start
    String metric = String(topic).substring(topic_of("incoming/").length());
    String account;
    if (metric.startsWith("by/")) {  // by/ACCOUNT/METRIC: the broker has checked this account
        int end = metric.indexOf('/', strlen("by/"));
        account = metric.substring(strlen("by/"), end);
        metric = metric.substring(end + 1);
    }
    robot.receive(metric, account, payload, size);
}

static void connect() {
    robot.halt();  // before connecting, which may take seconds
    retained.begin();
    JsonDocument gone;  // what the broker publishes when the connection is lost
    String text;
    gone["t"] = epoch_ms();
    gone["online"] = false;
    serializeJson(gone, text);
    String client_id = String("robot-") + ID;
    String online = topic_of("outgoing/online");
    if (!mqtt.connect(client_id.c_str(), USER, PASSWORD, online.c_str(), 1, true, text.c_str())) {
        delay(200);
        return;
    }
    // With QoS 0: what is longer than its buffer PubSubClient does not acknowledge, and then the broker sends no more.
    mqtt.subscribe(topic_of("incoming/#").c_str(), 0);
    publish_capabilities();
    robot.connected();
    Serial.println("connected");
}

void setup() {
    Serial.begin(115200);
    WiFi.begin(WIFI, WIFI_PASSWORD);
    while (WiFi.status() != WL_CONNECTED) delay(100);
    configTime(0, 0, "pool.ntp.org");  // without internet its times count from the start: it drives as well
    while (USER != nullptr && time(nullptr) < 1700000000) delay(100);  // but a certificate needs the date
    robot.begin(USER != nullptr);
    if (USER != nullptr) {
        secure.setCACert(CA);
        mqtt.setClient(secure);
    } else {
        mqtt.setClient(plain);
    }
    mqtt.setServer(HOST, PORT);
    mqtt.setCallback(receive);
    mqtt.setKeepAlive(5);      // seconds
    mqtt.setSocketTimeout(2);  // seconds
    mqtt.setBufferSize(1024);  // bytes
}

void loop() {
    if (!mqtt.loop()) connect();
    robot.tick();
    delay(1);
}
