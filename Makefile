# Two commands on a fresh machine: `make demo`, `make test`. Needs Python >= 3.11, nothing else prepared.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
export IRIS_DATA ?= $(abspath ../shared)

.PHONY: install install-dev demo test check bench clean help

help:
	@echo "make demo     two emulated operators hand a hammer over, recorded and verified"
	@echo "make test     lint, strict types, every test"
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

test: check
	$(BIN)/python -m pytest -q -m "not e2e" -n 2 --cov --cov-report= 
	$(BIN)/python -m pytest -q -m e2e -n 2 --dist loadfile
	$(BIN)/python -m coverage report --include="$(CORE)" --fail-under=95
	$(BIN)/python -m coverage report --omit="$(CORE)" --fail-under=90

# Every benchmark runs, whatever the one before says; the status is that of the worst.
bench: install
	@status=0; for bench in "state" "state --curve" "input" "slow-client"; do \
	  $(BIN)/iris-session bench $$bench --check || status=1; \
	done; exit $$status

clean:
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage*
