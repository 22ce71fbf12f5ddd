# Each target sets up what it needs inside this folder. Only `make test`, `make firmware` and `make report` install Debian
# packages, and only missing ones.

VENV := .venv/bin/python

.DEFAULT_GOAL := help
unexport PYTHONDONTWRITEBYTECODE  # every test starts programs: compiling them each time would cost a third of the time
.PHONY: help demo demo-options test quick thorough fleet stops soak floods schedules script-schedules page-schedules page-tests looks gstreamer gstreamer-tests brokers check firmware report clean lock audit sbom release life life-long check-types check-names check-collection quick-tests test-packages test-running test-robots test-computing test-checks test-demo test-waiting

help:
	@echo "make demo             four simulated robots, on Zenoh, on MQTT and on MCUs, driven through a broker; Ctrl-C ends it"
	@echo "make demo SECONDS=30  ends by itself; succeeds only if every robot moved, stopped and obeyed as it should"
	@echo "make demo PHONE=1     opens its page to the network, by https, with a login and a QR code"
	@echo "make demo FLEET=1     two robots that hear each other on a LAN, two hubs and a gateway; goob follows fred without the broker"
	@echo "make test             all checks and tests, some rows of each rule, some nine minutes"
	@echo "make quick            what to run before each commit: lint, types, contract, memory transport, one robot; a minute"
	@echo "make thorough         the same, with all rows, all cases of the random tests, and the tests that take longest"
	@echo "make fleet            brokers and hubs that are killed, hung and cut off under driven robots and 300 boards; 300 robots at a page; a quarter of an hour"
	@echo "make stops            400 random schedules of emergency stops and faults with whole robots, 40 minutes"
	@echo "make soak             floods, kills, freezes, full disks and more while an operator drives; MINUTES=30 for each transport"
	@echo "make floods           60,000 retained flags, 10,000 actions a second and more, also while a robot starts, four minutes"
	@echo "make schedules        10,000 random schedules of persons, control, scripts and faults in virtual time, six minutes"
	@echo "make script-schedules  200 of them with whole robots, 30 minutes"
	@echo "make page-tests       every state, card, interruption and finger at the operator page in Chromium, 20 minutes"
	@echo "make looks            store anew how the page looks, for make page-tests to compare; look at the pictures, a minute"
	@echo "make page-schedules   200 random sequences of inputs and faults at the operator page in Chromium, 15 minutes"
	@echo "make gstreamer-tests  install GStreamer and OpenCV for the system's Python, and have the original's local media read by them, three minutes"
	@echo "make brokers          install NATS, RabbitMQ and aedes where that is possible, test robots with them, judge them, seven minutes"
	@echo "make check            lint, types, imports and names only"
	@echo "make firmware         measure the firmware's use of each board in the real MicroPython; writes docs/firmware.md"
	@echo "make report           run every comparison and pebble impair, 95 minutes; writes docs/results"
	@echo "make report QUICK=1   fewer cases, five and a half minutes; writes build/report-quick"
	@echo "make lock             write requirements/ anew from pyproject.toml; UPGRADE=1: with the newest versions"
	@echo "make audit            ask OSV for known vulnerabilities of all packages; without an answer it fails: not checked"
	@echo "make sbom             write build/sbom.cdx.json: what a robot's software consists of"
	@echo "make release          write build/release: wheel, sdist, Debian package, SBOM, checksums; a minute"
	@echo "make life             install, update, damage and remove packages on machines with a real systemd; root, 15 minutes"
	@echo "make life-long        the same with all random cases"
	@echo "make clean            remove what the other targets created"

# Before the set-up, which takes a minute; the shortest is that of pebble.demo.main, rounded up.
demo-options:
	@test -n "$(FLEET)" || awk 'BEGIN { exit ARGV[1] + 0 < 26 }' "$(or $(SECONDS),26)" || \
		{ echo "make demo: one round of driving takes 26 s: give it at least that many, make demo SECONDS=30" >&2; exit 2; }
	@test -z "$(PHONE)" || test -t 1 || \
		{ echo "make demo: PHONE=1 prints a password, to a terminal only: start it in one, without a pipe" >&2; exit 2; }

demo: demo-options .venv/.ready-demo
	@$(VENV) -m pebble.cli demo $(if $(SECONDS),--seconds $(SECONDS)) $(if $(PHONE),--phone) $(if $(FLEET),--fleet)

TESTS := $(VENV) tools/run_tests.py
LESS := $(if $(PEBBLE_THOROUGH),, and not thorough)
# Runs when nothing else wants a processor.
GENTLY := chrt --idle 0
# Tests that check no times.
COMPUTING := tests/config tests/contract tests/media tests/motion tests/perception tests/test_packaging.py \
	$(addprefix tests/robot/test_,lockstep.py thin_schedules.py) tests/forwarding/test_command_ages.py \
	tests/runtime/test_by_name.py tests/simulation/world/test_lockstep.py \
	$(addprefix tests/recordings/,exports files seek traffic test_unread.py) \
	$(addprefix tests/bench/,judging $(addprefix test_,plots.py report.py results.py)) \
	$(addprefix tests/firmware/test_,compile.py deadman_virtual.py golden.py heap.py motor_boards.py outlets.py) \
	$(addprefix tests/firmware/test_,types.py vm.py) \
	$(addprefix tests/web/,modules $(addprefix test_,driving_lockstep.py log_lines.py page_clock.py recent.py types.py))
# Robots of a hundred lines, watched for most of a minute, and demos that end at once: they leave the processors to others.
WAITING := $(addprefix tests/conform/test_,conform.py operators.py) tests/test_demo.py
ENDING := nothing_outlives or does_not_come_up
# Files with tests of whole robots, to collect no others.
ALONE = $(filter-out $(WAITING),\
	$(shell grep --recursive --files-with-matches --include=test_*.py 'mark\.alone' tests))

# Each run of pytest appends what its tests took; without it, for parts that are called alone.
TIMES := .venv/test-times.tsv
export PEBBLE_TEST_TIMES := $(abspath $(TIMES))
SHOW_TIMES = $(VENV) tools/test_times.py $(TIMES)

quick: .venv/.ready-dev
	@sh tools/debian-packages.sh mosquitto=mosquitto
	@rm -f $(TIMES)
	@$(MAKE) --no-print-directory --jobs=3 check-types check-names quick-tests
	@$(SHOW_TIMES)

quick-tests:
	@$(TESTS) --workers 2 tests/contract tests/forwarding --ignore tests/forwarding/links
	@$(TESTS) -k memory tests/transports/test_contract.py
	@$(TESTS) -k "(drive_forms or silence) and zenoh" tests/robot/test_robot.py

# Types, lint and what only computes use what tests that wait and measure leave of the processors. pip and apt wait for
# their downloads, so both run at once, and types are checked meanwhile.
test:
	@rm -f $(TIMES)
	@$(MAKE) --no-print-directory --jobs=4 test-checks test-computing test-demo test-waiting
	@$(SHOW_TIMES)
	@$(VENV) tools/tree_growth.py

test-packages:
	@sh tools/debian-packages.sh mosquitto=mosquitto mosquitto_pub=mosquitto-clients chromium=chromium node=nodejs g++=g++ openssl=openssl ip=iproute2 tc=iproute2 nft=nftables systemd-analyze=systemd
	@test -e /usr/include/mosquitto.h -a -e /usr/include/cjson/cJSON.h || sh tools/debian-packages.sh =gcc =libc6-dev =libmosquitto-dev =libcjson-dev

test-running: test-packages .venv/.ready-dev
	@echo "pebble: tests"
	@$(TESTS) --workers 8 -m "not alone and not page$(LESS)" $(addprefix --ignore=,$(COMPUTING) tests/life) tests

test-checks: .venv/.ready-dev
	@$(GENTLY) $(MAKE) --no-print-directory --jobs=2 check-types check-names >.venv/checks.log 2>&1 || \
		{ cat .venv/checks.log; exit 1; }
	@echo "pebble: lint, types, imports and names are in order"

test-robots: test-running
	@echo "pebble: whole robots and serial lines, five at a time because these tests check deadlines"
	@$(TESTS) --workers 5 --spread -m "alone and not page$(LESS)" $(ALONE)

test-demo: test-robots
	@echo "pebble: the demo, whose robots need all processors"
	@$(TESTS) -m "not page$(LESS)" -k "not ($(ENDING))" tests/test_demo.py

test-waiting: test-running
	@$(TESTS) --workers 4 --spread -m "not page$(LESS)" -k "test_conform or test_operators or $(ENDING)" $(WAITING) >.venv/waiting.log 2>&1 || \
		{ cat .venv/waiting.log; exit 1; }
	@echo "pebble: robots of a hundred lines: $$(tail -n 1 .venv/waiting.log)"

test-computing: test-packages .venv/.ready-dev
	@$(GENTLY) $(TESTS) --workers 2 --timeout=600 -m "not alone and not page$(LESS)" $(COMPUTING) >.venv/computing.log 2>&1 || \
		{ cat .venv/computing.log; exit 1; }
	@echo "pebble: what only computes: $$(tail -n 1 .venv/computing.log)"

thorough: gstreamer
	@PEBBLE_THOROUGH=1 $(MAKE) --no-print-directory test

# Whole fleets; make test has one row of each rule.
FLEET_TESTS := tests/bench/test_fleet.py tests/transports/zenoh/test_mesh.py $(addprefix tests/fleet/test_,demo.py boards.py gateways.py lan.py hosts.py hubs.py neighbours.py typed.py)
fleet: .venv/.ready-dev
	@sh tools/debian-packages.sh mosquitto=mosquitto
	@PEBBLE_THOROUGH=1 $(TESTS) --workers 2 --spread --timeout 900 -s $(FLEET_TESTS)

# Every state of the operator page on every size, every card, its sound, every interruption, and fingers.
page-tests: .venv/.ready-dev
	@sh tools/debian-packages.sh mosquitto=mosquitto chromium=chromium
	@$(TESTS) -m page tests/web

# The pictures are as that browser draws them: another version of it may need new ones, too.
looks: .venv/.ready-dev
	@sh tools/debian-packages.sh chromium=chromium
	@$(VENV) -m tests.web.looks

# 250 MB, so only for those who ask for it: make test has a stand-in for shmsrc, which reads Debian's shmsink here.
gstreamer:
	@sh tools/debian-packages.sh gst-launch-1.0=gstreamer1.0-tools
	@gst-inspect-1.0 --exists shmsrc && gst-inspect-1.0 --exists videotestsrc || \
		sh tools/debian-packages.sh =gstreamer1.0-plugins-base =gstreamer1.0-plugins-bad
	@/usr/bin/python3 -c "import cv2, paho.mqtt.client" 2>/dev/null || \
		sh tools/debian-packages.sh =python3-opencv =python3-paho-mqtt

gstreamer-tests: .venv/.ready-dev gstreamer
	@sh tools/debian-packages.sh mosquitto=mosquitto
	@PEBBLE_THOROUGH=1 $(VENV) tools/run_tests.py tests/services/gstreamer_mirror tests/robot/test_original_media.py

# Brokers of other makers; where they are installed, make thorough tests them as well.
brokers: .venv/.ready-dev
	@sh tools/debian-packages.sh mosquitto=mosquitto
	@sh tools/brokers.sh
	@$(TESTS) -ra tests/transports/test_brokers.py tests/transports/test_client_ids.py tests/brokers
	@$(TESTS) -ra -k "(nats or another) and in_python" tests/conform

# What violates a rule is described in build/stops; the seed in its name repeats it.
stops: .venv/.ready-dev
	@sh tools/debian-packages.sh mosquitto=mosquitto
	@$(VENV) -m tests.robot.stop_schedules --transport zenoh --log build/stops
	@$(VENV) -m tests.robot.stop_schedules --transport mqtt --log build/stops

# Attacks at random while an operator drives; the seed repeats their order.
soak: .venv/.ready-dev
	@sh tools/debian-packages.sh mosquitto=mosquitto
	@$(VENV) -m tests.robot.soak --transport zenoh --minutes $(or $(MINUTES),5)
	@$(VENV) -m tests.robot.soak --transport mqtt --minutes $(or $(MINUTES),5)

floods: .venv/.ready-dev
	@sh tools/debian-packages.sh mosquitto=mosquitto
	@$(VENV) -m tests.robot.soak.floods --transport zenoh
	@$(VENV) -m tests.robot.soak.floods --transport mqtt

# The shortest schedule that violates a rule is printed.
schedules: .venv/.ready-dev
	@$(VENV) -m tests.kit.schedules motion --schedules 10000
	@$(VENV) -m tests.kit.schedules lockstep --schedules 10000
	@$(VENV) -m tests.kit.schedules lockstep --mutations --schedules 1000

script-schedules: .venv/.ready-dev
	@sh tools/debian-packages.sh mosquitto=mosquitto
	@$(VENV) -m tests.robot.script_schedules --transport zenoh
	@$(VENV) -m tests.robot.script_schedules --transport mqtt

# The seed of a sequence that violates a rule is printed, with what happened and what the motors did.
page-schedules: .venv/.ready-dev
	@sh tools/debian-packages.sh mosquitto=mosquitto chromium=chromium
	@$(VENV) -m tests.web.chromium_schedules

# Without root or namespaces its tests are skipped, and name what is missing.
life: .venv/.ready-dev .venv/wheels/.ready
	@sh tools/debian-packages.sh mosquitto=mosquitto mosquitto_pub=mosquitto-clients ip=iproute2 systemd-analyze=systemd minisign=minisign
	@$(TESTS) --timeout=900 -ra tests/configs/test_slot.py tests/update tests/life

life-long:
	@PEBBLE_THOROUGH=1 $(MAKE) --no-print-directory life

# What a slot is built from, for the system's own Python.
.venv/wheels/.ready: requirements/robot.txt | .venv/.ready-dev
	@echo "pebble: fetching the packages of a robot, 140 MB"
	@rm -rf $(@D)
	@$(VENV) -m pip download --quiet --disable-pip-version-check --require-hashes --only-binary :all: --dest $(@D) -r $<
	@touch $@

release: .venv/.ready-dev sbom
	@sh tools/debian-packages.sh dpkg-deb=dpkg
	@$(VENV) tools/release.py --sbom build/sbom.cdx.json

firmware: .venv/.ready-dev
	@sh tools/debian-packages.sh node=nodejs
	@$(VENV) -m tests.firmware.sizes

# Parts whose packages cannot be installed are left out, and the report says so; only a broker is required.
report: .venv/.ready-bench
	@sh tools/debian-packages.sh mosquitto=mosquitto
	@sh tools/debian-packages.sh ip=iproute2 tc=iproute2 nft=nftables || echo "pebble: without them pebble impair fails"
	@$(VENV) -c "import sys; from pebble.bench.frames import missing; sys.exit(missing('gstreamer-shm') is not None)" || \
		sh tools/debian-packages.sh =gstreamer1.0-plugins-base =gstreamer1.0-plugins-bad =gir1.2-gst-plugins-base-1.0 \
		=python3-gst-1.0 =python3-numpy || echo "pebble: continuing without GStreamer"
	@$(VENV) -m pebble.cli bench report $(if $(QUICK),--quick build/report-quick,docs/results)

check: .venv/.ready-dev
	@$(MAKE) --no-print-directory --jobs=3 --output-sync check-types check-names check-collection

check-types:
	@echo "pebble: types"
	@$(VENV) -m mypy

check-names:
	@echo "pebble: lint"
	@$(VENV) -m ruff check
	@$(VENV) -m ruff format --check
	@echo "pebble: imports"
	@.venv/bin/lint-imports --no-logo
	@echo "pebble: retired identifiers"
	@$(VENV) tools/retired_names.py
	@echo "pebble: types of the firmware"
	@$(VENV) -m tests.firmware.types

# Once, before six processes each compile what pytest makes of all tests.
check-collection:
	@echo "pebble: collection of the tests"
	@$(VENV) -m pytest --quiet --collect-only tests >.venv/collection.log || { cat .venv/collection.log; exit 1; }

clean:
	rm -rf .venv build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# What pins, audits and lists the packages is apart from them, and pinned by hashes, too.
lock audit sbom: .venv/.ready-tools
	@PYTHONPATH=.venv/tools $(VENV) tools/$@.py $(if $(UPGRADE),--upgrade)

.venv/.ready-tools: requirements/tools.txt | .venv/.ready-demo
	@echo "pebble: installing uv, pip-audit and cyclonedx-bom into .venv/tools"
	@rm -rf .venv/tools
	@$(VENV) -m pip install --quiet --disable-pip-version-check --require-hashes --target .venv/tools -r $<
	@touch $@

.venv/.ready-demo .venv/.ready-bench .venv/.ready-dev: .venv/.ready-%: requirements/%.txt

.venv/.ready-%: pyproject.toml tools/setup.sh tools/fetch_npm.py tools/npm.py
	@sh tools/setup.sh $*
