# Everything a target needs it sets up by itself, inside this folder. Only `make test` installs Debian packages, and
# only those that are missing.

VENV := .venv/bin/python

.DEFAULT_GOAL := help
.PHONY: help demo test check firmware footprint clean

help:
	@echo "make demo             four simulated robots, on Zenoh, on MQTT and on MCUs, driven through a broker; Ctrl-C ends it"
	@echo "make demo SECONDS=20  the same, ending by itself; succeeds only if every robot moved and stopped as commanded"
	@echo "make test             all checks and tests"
	@echo "make check            lint, types and imports only"
	@echo "make firmware         what the firmware costs of each board, measured in the real MicroPython; into docs/firmware.md"
	@echo "make footprint        what a robot costs and how fast it is: memory, CPU, start, latency; mqtt beside zenoh"
	@echo "make clean            remove what the other targets made"

demo: .venv/.ready-demo
	@$(VENV) -m pebble.cli demo $(if $(SECONDS),--seconds $(SECONDS))

test: check
	@sh tools/debian-packages.sh mosquitto=mosquitto mosquitto_pub=mosquitto-clients node=nodejs
	@echo "pebble: tests"
	@$(VENV) -m pytest --numprocesses 4 --dist loadscope --no-loadscope-reorder -m "not alone"
	@echo "pebble: whole robots and lines, two at a time because their deadlines are checked"
	@$(VENV) -m pytest --numprocesses 2 --dist loadscope -m alone tests/robot tests/services

firmware: .venv/.ready-dev
	@sh tools/debian-packages.sh node=nodejs
	@$(VENV) -m tests.firmware.sizes

footprint: .venv/.ready-dev
	@$(VENV) -m tests.robot.footprint

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
