# Everything a target needs it sets up by itself, inside this folder. Only `make test` and `make report` install Debian
# packages, and only those that are missing.

VENV := .venv/bin/python

.DEFAULT_GOAL := help
.PHONY: help demo test check firmware report clean

help:
	@echo "make demo             four simulated robots, on Zenoh, on MQTT and on MCUs, driven through a broker; Ctrl-C ends it"
	@echo "make demo SECONDS=20  the same, ending by itself; succeeds only if every robot moved and stopped as commanded"
	@echo "make test             all checks and tests"
	@echo "make check            lint, types and imports only"
	@echo "make firmware         what the firmware costs of each board, measured in the real MicroPython; into docs/firmware.md"
	@echo "make report           every comparison and the bad links, an hour; writes docs/results"
	@echo "make report QUICK=1   the same from fewer cases, under five minutes; writes build/report-quick"
	@echo "make clean            remove what the other targets made"

demo: .venv/.ready-demo
	@$(VENV) -m pebble.cli demo $(if $(SECONDS),--seconds $(SECONDS))

test: check
	@sh tools/debian-packages.sh mosquitto=mosquitto mosquitto_pub=mosquitto-clients node=nodejs ip=iproute2 tc=iproute2 nft=nftables
	@echo "pebble: tests"
	@$(VENV) -m pytest --numprocesses 4 --dist loadscope --no-loadscope-reorder -m "not alone"
	@echo "pebble: whole robots and lines, two at a time because their deadlines are checked"
	@$(VENV) -m pytest --numprocesses 2 --dist loadscope -m alone tests/robot tests/services tests/test_demo.py

firmware: .venv/.ready-dev
	@sh tools/debian-packages.sh node=nodejs
	@$(VENV) -m tests.firmware.sizes

# What is missing for a part of it and cannot be installed is left out, and the report says so; it takes a broker, though.
report: .venv/.ready-bench
	@sh tools/debian-packages.sh mosquitto=mosquitto
	@sh tools/debian-packages.sh ip=iproute2 tc=iproute2 nft=nftables || echo "pebble: without them a proxy is the bad link"
	@$(VENV) -c "import sys; from pebble.bench.frames_variants import missing; sys.exit(missing('gstreamer-shm') is not None)" || \
		sh tools/debian-packages.sh =gstreamer1.0-plugins-base =gstreamer1.0-plugins-bad =gir1.2-gst-plugins-base-1.0 \
		=python3-gst-1.0 =python3-numpy || echo "pebble: going on without GStreamer"
	@$(VENV) -m pebble.cli bench report $(if $(QUICK),--quick build/report-quick,docs/results)

check: .venv/.ready-dev
	@echo "pebble: lint"
	@$(VENV) -m ruff check
	@$(VENV) -m ruff format --check
	@echo "pebble: types"
	@$(VENV) -m mypy
	@$(VENV) -m tests.firmware.types
	@echo "pebble: imports"
	@.venv/bin/lint-imports --no-logo

clean:
	rm -rf .venv build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/.ready-%: pyproject.toml tools/setup.sh tools/fetch_micropython.py
	@sh tools/setup.sh $*
