// Runs a sketch: robot ID HOST PORT STOP_FILE [USER PASSWORD_FILE CA_FILE], or operator ID HOST PORT [USER …]
#include "Arduino.h"
#include "settings.h"
#include <fstream>
#include <iterator>
#include <string>

static const char *whole(const char *name) {
    std::ifstream file(name);
    return strdup(std::string(std::istreambuf_iterator<char>(file), {}).c_str());
}
int main(int argc, char **argv) {
    if (argc != 4 && argc != 5 && argc != 7 && argc != 8) return 2;
    bool is_robot = argc == 5 || argc == 8;
    ID = argv[1], HOST = argv[2], PORT = atoi(argv[3]), STOP_FILE = is_robot ? argv[4] : "";
    if (argc > 5) USER = argv[argc - 3], PASSWORD = whole(argv[argc - 2]), CA = whole(argv[argc - 1]);
    for (setup();;) loop();
}
