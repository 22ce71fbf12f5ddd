#!/bin/sh
# Runs a part of the tests that takes too long for each commit: make long PART=stops. Without a part it lists them.
set -eu
python=.venv/bin/python

debian() { sh tools/debian-packages.sh "$@"; }
tests() { PEBBLE_THOROUGH=1 $python -m pytest "$@"; }
tool() { PYTHONPATH=.venv/tools $python "$@"; }

list() {
    cat <<END
make long PART=stops      400 random schedules of people, stops, scripts and faults with whole robots, two hours
make long PART=soak       floods, kills, freezes, full disks and more while an operator drives, ten minutes
make long PART=schedules  random schedules in virtual time, an hour
make long PART=page       every state, card, interruption and finger at the operator page in Chromium, 25 minutes
make long PART=engines    drive and stop a robot at the page in Firefox and WebKitGTK, five minutes
make long PART=looks      store anew how the page looks, for PART=page to compare; look at the pictures, a minute
make long PART=fleet      brokers and hubs that are killed, hung and cut off under driven robots and 300 boards, three minutes
make long PART=brokers    install NATS, RabbitMQ and aedes where possible, test robots with them, judge them, seven minutes
make long PART=gstreamer  install GStreamer and OpenCV, and have them read the original's local media, three minutes
make long PART=ros1       install Debian's rosmaster, rospy and roscpp where possible, and test the bridge with them, four minutes
make long PART=metrics    install Prometheus where possible, and have its promtool judge alerts and metrics, a minute
make long PART=firmware   measure the firmware's use of each board's memory in the real MicroPython
make long PART=life       install, update, damage and remove packages on machines with a real systemd; root, 15 minutes
make long PART=lowest     core, films, Foxglove and the demo with the lowest versions that pyproject.toml admits, ten minutes
make long PART=packages   known vulnerabilities of all packages, from OSV, and build/sbom.cdx.json
END
}

case "$1" in
stops | soak | schedules | fleet | brokers | gstreamer | life | lowest) debian mosquitto=mosquitto ;;
page) debian mosquitto=mosquitto chromium=chromium ;;
looks) debian chromium=chromium ;;
engines)
    debian mosquitto=mosquitto firefox-esr=firefox-esr WebKitWebDriver=webkit2gtk-driver Xvfb=xvfb
    PATH=$PATH:/sbin ldconfig -p | grep -q libavcodec.so || debian =libavcodec-extra # Firefox has H.264 from it
    ;;
esac

case "$1" in
stops) $python -m tests.kit.schedules robot --log build/stops ;;
soak) tests tests/robot/test_faults.py tests/robot/test_surroundings.py ;;
schedules) # the shortest schedule that violates a rule is printed, or the seed of a sequence that does
    $python -m tests.kit.schedules motion --schedules 10000
    $python -m tests.kit.schedules services --schedules 20000 --jobs 2
    ;;
page) $python -m pytest --workers 8 -m page --ignore tests/ext/page/test_engines.py tests/ext/page ;;
engines) $python -m pytest -ra -m page tests/ext/page/test_engines.py ;;
looks) PEBBLE_LOOKS=store $python -m pytest -m page -k looks_as_it_is_stored tests/ext/page/page/test_look.py ;;
fleet) tests --workers 2 --timeout 900 -s tests/ext/fleet ;;
brokers)
    sh tests/ext/checks/brokers/install.sh
    $python -m pytest -ra tests/transports/test_brokers.py tests/ext/checks/brokers
    $python -m pytest -ra -k "nats" tests/ext/checks/conform
    ;;
gstreamer)
    debian gst-launch-1.0=gstreamer1.0-tools
    { gst-inspect-1.0 --exists shmsrc && gst-inspect-1.0 --exists rawvideoparse; } ||
        debian =gstreamer1.0-plugins-base =gstreamer1.0-plugins-bad
    /usr/bin/python3 -c "import cv2, paho.mqtt.client" 2>/dev/null || debian =python3-opencv =python3-paho-mqtt
    tests tests/examples/test_gstreamer_sockets.py
    ;;
ros1)
    { [ -x /usr/lib/topic_tools/relay ] &&
        /usr/bin/python3 -c "import rosmaster, rospy, nav_msgs.msg, diagnostic_msgs.msg, actionlib_msgs.msg" 2>/dev/null; } ||
        debian =topic-tools =python3-rosmaster =python3-rospy =python3-nav-msgs =python3-geometry-msgs =python3-std-msgs \
            =python3-diagnostic-msgs =python3-actionlib-msgs
    tests -ra tests/ext/ros1_bridge
    ;;
metrics)
    debian promtool=prometheus
    tests -ra tests/ext/metrics
    ;;
firmware) tests --log-cli-level=INFO tests/firmware/test_heap.py ;;
life)
    debian mosquitto_pub=mosquitto-clients ip=iproute2 systemd-analyze=systemd minisign=minisign
    sh tools/locked.sh robot >.venv/robot.txt
    cmp -s .venv/robot.txt .venv/wheels/robot.txt || {
        echo "pebble: fetching the packages of a robot, 140 MB"
        rm -rf .venv/wheels
        $python -m pip download --quiet --require-hashes --only-binary :all: --dest .venv/wheels -r .venv/robot.txt
        cp .venv/robot.txt .venv/wheels/robot.txt
    }
    tests --timeout=900 -ra tests/configs/test_slot.py tests/ext/install/update tests/ext/install/life
    ;;
lowest)
    sh tools/setup.sh tools
    tool -m uv pip compile --no-config --quiet --resolution lowest-direct --all-extras --no-header --no-annotate \
        --python "$python" --output-file .venv/lowest.txt pyproject.toml
    tool -m uv venv --no-config --quiet --clear --python "$python" .venv/lowest
    in_lowest() { tool -m uv pip install --no-config --quiet --python .venv/lowest/bin/python "$@"; }
    in_lowest --requirement .venv/lowest.txt
    in_lowest --no-deps --no-build-isolation --editable .
    .venv/lowest/bin/lint-imports --no-logo
    python=.venv/lowest/bin/python
    $python tools/imports.py
    # Other versions of msgspec list the alternatives of a schema in another order.
    $python -m pytest --workers 4 -m "not page and not thorough" --ignore tests/ext \
        --deselect tests/config/test_schema.py::test_the_schema_is_one_and_up_to_date_and_names_no_folder_of_this_machine tests
    $python -m pytest --workers 2 -m "not page and not thorough" tests/ext/recordings tests/ext/foxglove tests/ext/operator
    $python -m pebble.cli demo --seconds 26
    ;;
packages)
    sh tools/setup.sh tools
    tool tools/sbom.py
    tool -m pip_audit --requirement requirements.txt --require-hashes --disable-pip --vulnerability-service osv
    ;;
*)
    list
    [ -z "$1" ] || {
        echo "make long: there is no part '$1'" >&2
        exit 2
    }
    ;;
esac
