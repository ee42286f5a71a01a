# Every target sets up what it needs in .venv, once. Python 3.11 with pip is all it asks for.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
INSTALLED := .venv/installed

# What `make mutate` changes, and how many changes to a module it draws; 0: all, which takes hours.
MODULES ?= $(wildcard condwrap/[a-z]*.py) condwrap/attacks condwrap/penalties \
	baselines/ppo_reg.py baselines/trpo_reg.py \
	harness/suite.py harness/store.py harness/archive.py harness/record.py harness/identity.py \
	harness/report/tables/table1.py harness/report/tables/table2.py \
	harness/statistics harness/report/claims harness/evaluation
SAMPLE ?= 60

# Each has tests/integrations/NAME.txt, test_NAME.py and condwrap/integrations/NAME*.py.
FRAMEWORKS ?= $(basename $(notdir $(wildcard tests/integrations/*.txt)))

.PHONY: help run test tests slow check bench integrations mutate lock clean

help:  ## what each target does
	@sed -n 's/^\([a-z]*\):.*##/\1\t/p' Makefile | expand -t 14

run: $(INSTALLED)  ## the main job: a first comparison, every agent at toy length, one page of both
	$(BIN)/python -m harness run-all --suite first smoke
	@echo "Look at results/report/report.html"

test: $(INSTALLED)  ## the default tests, in minutes
	$(BIN)/python -m pytest --numprocesses=auto --cov=condwrap --cov-fail-under=100

tests: test

slow: $(INSTALLED)  ## the tests that take minutes each or need a C++ compiler
	$(BIN)/python -m pytest -m slow

check: $(INSTALLED)  ## lint, format, types and the direction of imports
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(INSTALLED)  ## benchmarks beside their peers, as one table; under half an hour
	$(BIN)/python -m pip install --quiet --no-deps stable-baselines3==2.9.2 sb3-contrib==2.9.2
	$(BIN)/python -m pytest tests/benchmarks --benchmark-enable --benchmark-only --quiet -m '' \
		--benchmark-json=benchmarks.json --benchmark-columns=median
	$(BIN)/python -m tests.benchmarks.table benchmarks.json
	$(BIN)/python -m tests.benchmarks.figure benchmarks.json benchmarks.png

integrations: $(FRAMEWORKS:%=integration-%)  ## tests with other frameworks, in environments of their own; FRAMEWORKS=sb3 chooses
	@echo "passed: $(FRAMEWORKS)"

integration-%: .venv-%/installed
	.venv-$*/bin/python -m pytest tests/integrations/test_$*.py \
		$(wildcard condwrap/integrations/$**.py) \
		--override-ini=addopts='--doctest-modules --strict-markers' \
		$(if $(wildcard condwrap/integrations/$**.py),--cov --cov-fail-under=95 \
		--cov-config=tests/integrations/coverage.ini --cov-report=term-missing)

.venv-%/installed: tests/integrations/%.txt pyproject.toml
	$(PYTHON) -m venv .venv-$*
	.venv-$*/bin/python -m pip install --quiet --requirement $<
	.venv-$*/bin/python -m pip install --quiet --editable .
	@touch $@
.PRECIOUS: .venv-%/installed

mutate: $(INSTALLED)  ## how many small changes the tests notice; MODULES=... chooses, SAMPLE=0 makes all
	$(BIN)/python -m pip install --quiet --no-deps mutmut==3.8.1 libcst==1.9.0
	$(BIN)/python tests/mutation --sample $(SAMPLE) $(MODULES)

$(INSTALLED): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "condwrap needs Python 3.11 or newer: make PYTHON=/path/to/python3.11"; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

lock:  ## write requirements.lock anew, from the newest versions that fit
	rm -rf .venv-lock && $(PYTHON) -m venv .venv-lock
	.venv-lock/bin/pip install --quiet torch==2.13.0 hatchling editables
	.venv-lock/bin/pip install --quiet '.[harness,bullet,coinrun,video,dev]'
	echo '# Exact versions for Python 3.11 of all extras but wandb, written by `make lock`.' > requirements.lock
	.venv-lock/bin/pip freeze --all | grep -v '^pip==\|^condwrap' | sed 's/+cpu//' >> requirements.lock
	rm -rf .venv-lock

clean:  ## remove the environment and caches; results/ and runs/ stay
	rm -rf .venv .venv-* .coverage .hypothesis .*_cache dist
	find . -name __pycache__ -not -path './.git/*' -prune -exec rm -rf {} +
