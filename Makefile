# Each target sets up what it needs inside this folder. Debian packages are installed by `make test`, `make long` and
# `make report` only, and only missing ones.

VENV := .venv/bin/python
DEBIAN := sh tools/debian-packages.sh

.DEFAULT_GOAL := help
unexport PYTHONDONTWRITEBYTECODE  # every test starts programs: compiling them each time would cost a third of the time
.PHONY: help demo test check docs site long report lock release clean

help:
	@echo "make demo              four simulated robots, on Zenoh, on MQTT and on MCUs, driven through a broker; Ctrl-C ends it"
	@echo "make demo SECONDS=30   ends by itself; succeeds only if every robot moved, stopped and obeyed as it should"
	@echo "make demo PHONE=1      opens its page to the network, by https, with a login and a QR code"
	@echo "make test              all checks and tests, some rows of each rule, some six minutes; THOROUGH=1: all rows"
	@echo "make test QUICK=1      what to run before each commit: lint, types, contract, bridge, transports, motion; a minute and a half"
	@echo "make check             lint, types and imports only"
	@echo "make docs              write build/docs: tables of all topics, config keys, web messages, words and bounds; schemas"
	@echo "make site              write build/site: the documents and the API as a web site, its links checked; a minute"
	@echo "make long PART=stops   one of the parts that take long; make long lists them"
	@echo "make report            run every comparison, 65 minutes; writes build/report; QUICK=1: fewer cases, six minutes"
	@echo "make lock              write requirements.txt anew from pyproject.toml; UPGRADE=1: with the newest versions"
	@echo "make release           write build/release: wheel, sdist, Debian package, SBOM, checksums; a minute"
	@echo "make clean             remove what the other targets created"

# The options are checked before the set-up, which takes a minute; the shortest is that of the demo, rounded up.
demo:
	@awk 'BEGIN { exit ARGV[1] + 0 < 26 }' "$(or $(SECONDS),26)" || \
		{ echo "make demo: one round of driving takes 26 s: give it at least that many, make demo SECONDS=30" >&2; exit 2; }
	@test -z "$(PHONE)" || test -t 1 || \
		{ echo "make demo: PHONE=1 prints a password, to a terminal only: start it in one, without a pipe" >&2; exit 2; }
	@$(MAKE) --no-print-directory .venv/.ready-demo
	@$(VENV) -m pebble.cli demo $(if $(SECONDS),--seconds $(SECONDS)) $(if $(PHONE),--phone)

# Types and lint use what tests leave of the processors. Several hundred tests start whole robots and check deadlines on two
# processors: one of them may miss its own, so what failed runs a second time.
QUICKLY := --workers 4 -m "not page and not thorough and not alone" tests/contract tests/forwarding tests/motion \
	tests/robot/test_lockstep.py tests/transports/test_contract.py
WHOLE := --workers 8 --durations 10 -m "not page$(if $(THOROUGH),, and not thorough)" --ignore tests/ext/install/life tests
test: .venv/.ready-dev
	@$(DEBIAN) mosquitto=mosquitto mosquitto_pub=mosquitto-clients chromium=chromium g++=g++ openssl=openssl \
		ip=iproute2 tc=iproute2 nft=nftables systemd-analyze=systemd
	@test -e /usr/include/cjson/cJSON.h || $(DEBIAN) =libcjson-dev
	@chrt --idle 0 $(MAKE) --no-print-directory check >.venv/checks.log 2>&1 & checks=$$!; \
	$(if $(THOROUGH),export PEBBLE_THOROUGH=1;) \
	rm -rf .venv/failed; \
	$(VENV) -m pytest -o cache_dir=.venv/failed $(if $(QUICK),$(QUICKLY),$(WHOLE)); tests=$$?; \
	test $$tests != 1 || { echo "pebble: what failed beside others runs once more, alone; please report what passes now"; \
		$(VENV) -m pytest -o cache_dir=.venv/failed --last-failed --last-failed-no-failures none tests; tests=$$?; }; \
	wait $$checks || { cat .venv/checks.log; exit 1; }; \
	tail -n 1 .venv/checks.log; exit $$tests

check: .venv/.ready-dev
	@$(VENV) -m ruff check
	@$(VENV) -m ruff format --check
	@$(VENV) tools/docstrings.py
	@.venv/bin/lint-imports --no-logo
	@$(VENV) -m mypy
	@$(VENV) -m tests.firmware.types
	@echo "pebble: lint, types and imports are in order"

docs: .venv/.ready-dev
	@$(VENV) -m pebble.extensions.operator.contract.docs build/docs
	@$(VENV) tools/schema.py build/docs
	@$(VENV) tools/messages_docs.py build/docs
	@$(VENV) tools/bounds.py build/docs

long: .venv/.ready-dev
	@sh tools/long.sh "$(PART)"

# Comparisons whose packages cannot be installed are left out, and the report says so; only a broker is required.
report: .venv/.ready-dev
	@$(DEBIAN) mosquitto=mosquitto
	@$(DEBIAN) ip=iproute2 tc=iproute2 nft=nftables || echo "pebble: without them pebble bench impair fails"
	@$(VENV) -c "import sys; from pebble.extensions.lab.bench.frames import missing; sys.exit(missing('gstreamer-shm') is not None)" || \
		$(DEBIAN) =gstreamer1.0-plugins-base =gstreamer1.0-plugins-bad =gir1.2-gst-plugins-base-1.0 \
		=python3-gst-1.0 =python3-numpy || echo "pebble: continuing without GStreamer"
	@$(VENV) -m pebble.cli bench report $(if $(QUICK),--quick build/report-quick,build/report)

lock: .venv/.ready-tools
	@PYTHONPATH=.venv/tools $(VENV) tools/lock.py $(if $(UPGRADE),--upgrade)

site: docs .venv/.ready-tools
	@PYTHONPATH=.venv/tools:. $(VENV) tools/site.py

release: .venv/.ready-dev .venv/.ready-tools
	@$(DEBIAN) dpkg-deb=dpkg
	@PYTHONPATH=.venv/tools $(VENV) tools/sbom.py
	@$(VENV) tools/release.py --sbom build/sbom.cdx.json

clean:
	rm -rf .venv node_modules build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/.ready-%: pyproject.toml requirements.txt package-lock.json tools/setup.sh
	@sh tools/setup.sh $*
