// What differs from robot to robot. Copy it to settings.h, which robot.cpp includes.
#pragma once
#include <cstdint>

static const char *const WIFI = "my network";
static const char *const WIFI_PASSWORD = "its password";
static const char *const ID = "mine";  // of the robot: its topics begin with pebble/robots/mine/
static const char *const HOST = "192.168.1.10";  // of the broker: its address, or its name
static const uint16_t PORT = 1883;               // 8883 with TLS

// At level named, see docs/ext/fleet.md, commands count only under the account of their sender. The robot has one, too;
// CA is the certificate of the broker's authority as text, "-----BEGIN CERTIFICATE-----\n...". At level open they
// are nullptr, and there is no TLS.
static const char *const USER = nullptr;
static const char *const PASSWORD = nullptr;
static const char *const CA = nullptr;
