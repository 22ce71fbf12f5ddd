#!/bin/sh
# Installs Debian packages whose programs are missing: debian-packages.sh PROGRAM=PACKAGE …
# An empty PROGRAM always installs. Also looks in the sbin folders, where Debian puts brokers and which users' PATH lacks.
set -eu
PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin

missing=
for pair in "$@"; do
    program=${pair%%=*}
    [ -n "$program" ] && command -v "$program" >/dev/null || missing="$missing ${pair#*=}"
done
[ -n "$missing" ] || exit 0

give_up() {
    printf 'pebble: %s\n' "$1" "as root: apt-get install$missing" >&2
    exit 1
}

command -v apt-get >/dev/null || give_up "missing:$missing. This is not Debian: install them with your package manager, or"
if [ "$(id -u)" = 0 ]; then
    sudo=
elif ! command -v sudo >/dev/null; then
    give_up "missing:$missing. Neither root nor sudo is available;"
elif [ -t 0 ]; then
    sudo=sudo
else
    sudo="sudo -n" # no terminal to type a password
fi

printf 'pebble: installing%s\n' "$missing"
apt() {
    # shellcheck disable=SC2086
    $sudo env DEBIAN_FRONTEND=noninteractive apt-get -qq -o Dpkg::Use-Pty=0 "$@" >/dev/null
}
# shellcheck disable=SC2086
apt install -y --no-install-recommends $missing 2>/dev/null || { apt update && apt install -y --no-install-recommends $missing; } ||
    give_up "missing:$missing. apt-get could not install them;"
