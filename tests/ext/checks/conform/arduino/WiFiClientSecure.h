// TLS by the openssl program, which ends with this one.
#pragma once
#include "WiFi.h"
#include <fcntl.h>
#include <signal.h>
#include <sys/mman.h>
#include <sys/prctl.h>

class WiFiClientSecure : public WiFiClient {
public:
    void setCACert(const char *pem) { pem_ = pem; }

protected:
    int dial(const char *host, uint16_t port) override {
        int ends[2], ca = memfd_create("ca", 0);
        if (::write(ca, pem_, strlen(pem_)) < 0 || socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, ends)) return -1;
        std::string file = "/proc/self/fd/" + std::to_string(ca), to = std::string(host) + ":" + std::to_string(port);
        signal(SIGCHLD, SIG_IGN);
        if (fork() == 0) {
            prctl(PR_SET_PDEATHSIG, SIGKILL);
            dup2(ends[1], 0), dup2(ends[1], 1), dup2(open("/dev/null", O_WRONLY), 2);
            execlp("openssl", "openssl", "s_client", "-quiet", "-no_ign_eof", "-nocommands", "-verify_return_error",
                   isdigit(*host) ? "-verify_ip" : "-verify_hostname", host, "-CAfile", file.c_str(), "-connect", to.c_str(), nullptr);
            _exit(1);
        }
        close(ends[1]), close(ca);
        return ends[0];
    }

private:
    const char *pem_ = "";
};
