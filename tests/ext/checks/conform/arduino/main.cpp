// Runs the sketch: robot ID HOST PORT STOP_FILE [USER PASSWORD_FILE CA_FILE]
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
    if (argc != 5 && argc != 8) return 2;
    ID = argv[1], HOST = argv[2], PORT = atoi(argv[3]), STOP_FILE = argv[4];
    if (argc == 8) USER = argv[5], PASSWORD = whole(argv[6]), CA = whole(argv[7]);
    for (setup();;) loop();
}
