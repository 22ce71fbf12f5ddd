// What main.cpp takes from its command line; on a board these are constants.
#pragma once
#include <cstdint>
inline const char *WIFI = "", *WIFI_PASSWORD = "", *ID, *HOST, *USER, *PASSWORD, *CA, *STOP_FILE;
inline uint16_t PORT;
