# Two commands on a fresh machine: `make demo`, `make test`. Needs Python >= 3.11, nothing else prepared.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
export IRIS_DATA ?= $(abspath ../shared)
# Some environments forbid compiled files: then each process that a test starts compiles all our modules anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install install-dev demo test check test-unit test-e2e test-random coverage bench clean help

help:
	@echo "make demo     two emulated operators hand a hammer over, recorded and verified"
	@echo "make test     lint, strict types, every test: the four below"
	@echo "  make check      lint, format, strict types"
	@echo "  make test-unit  tests in one process;  make test-unit T=tests/control  those of one room"
	@echo "  make test-e2e   tests that start real processes;  make test-e2e T=tests/e2e/test_people.py"
	@echo "  make coverage   the bounds of coverage, after test-unit"
	@echo "make test-random  the unit tests with other random examples than the usual ones"
	@echo "make bench    the benchmarks of the README"
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

install: $(VENV)/.installed
install-dev: $(VENV)/.installed-dev

demo: install
	@$(BIN)/iris-session demo handover

check: install-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# What decides; the rest talks to sockets, disks and people.
CORE := iris_session/authority/*,iris_session/protocol/*,iris_session/control/*

# Tests at once, and which; the suite is made for two.
JOBS ?= 2
T ?= tests

UNIT = $(BIN)/python -m pytest -q -m "not e2e" -n $(JOBS) --cov --cov-report=

# A file stays on one worker, because its tests share sessions; the longest begin first (tests/e2e/conftest.py).
# These tests run real processes in real time: a machine that is taken away for a second can fail one. When the run was
# whole and tests failed (status 1), they are named and judged once more, alone; what fails twice fails.
define E2E
$(BIN)/python -m pytest -q -m e2e -n $(JOBS) --dist loadfile --no-loadscope-reorder $(T); status=$$?; \
if [ $$status -eq 1 ]; then \
  echo "FAILED AT FIRST, judged once more, alone:"; \
  $(BIN)/python -m pytest -v -m e2e --last-failed --last-failed-no-failures none $(T); status=$$?; \
fi
endef

# Unit tests that start no session and wait for no clock, those that take long: `make test` runs them on what the
# processes of the tests end to end leave of the machine, which wait for each other a third of the time. `IDLE` takes
# nothing from who wants to run.
PURE := $(wildcard $(addprefix tests/,anchors authority control physics protocol scene streams \
  bench/test_alignment.py cli/test_anchors.py cli/test_anchors_solve.py \
  $(addprefix emulator/test_,behaviours.py behaviours_parts.py demo_casts.py soft_demos.py) \
  $(addprefix recording/test_,looks.py reader.py verify.py writer.py) \
  $(addprefix runtime/test_,continuation.py core.py goals.py plays.py replay_stress.py) \
  $(addprefix transport/test_,alignment_desk.py anchoring.py)))
IDLE := $(shell chrt --idle 0 true 2>/dev/null && echo chrt --idle 0 || echo nice -n 19)

test: check
	COVERAGE_FILE=.coverage-live $(UNIT) $(addprefix --ignore=,$(PURE)) tests
	@mkdir -p build; echo "beside the next, told after it: $(UNIT) $(PURE)"; \
	COVERAGE_FILE=.coverage-pure $(IDLE) $(UNIT) --dist worksteal -p no:cacheprovider --timeout=1800 $(PURE) >build/pure.log 2>&1 & \
	pure=$$!; trap 'kill $$pure' INT TERM; \
	$(E2E); wait $$pure; beside=$$?; cat build/pure.log; exit $$((status + beside))
	$(BIN)/python -m coverage combine --quiet .coverage-live .coverage-pure
	$(MAKE) --no-print-directory coverage

test-unit: install-dev
	$(UNIT) $(T)

test-e2e: install-dev
	@$(E2E); exit $$status

test-random: install-dev
	HYPOTHESIS=random $(BIN)/python -m pytest -q -m "not e2e" -n $(JOBS) $(T)

coverage: install-dev
	$(BIN)/python -m coverage report --include="$(CORE)" --fail-under=95
	$(BIN)/python -m coverage report --omit="$(CORE)" --fail-under=90

# Every benchmark runs, whatever the one before says; the status is that of the worst.
bench: install
	@status=0; for bench in "state" "state --curve" "input" "slow-client" "alignment"; do \
	  $(BIN)/iris-session bench $$bench --check || status=1; \
	done; exit $$status

clean:
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage*
