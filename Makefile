# Everything is installed into .venv, but for system libraries that are missing.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= out
JOBS ?= 2
# What make test installs: newest (the newest versions that pyproject.toml allows), locked (those of .ci/locked.txt,
# checked by their hashes) or lowest (the oldest that pyproject.toml allows). For a new $(VENV): make clean before another.
DEPENDENCIES ?= newest
# Modules stay compiled, also where the environment says otherwise: tests and demo start many processes.
export PYTHONDONTWRITEBYTECODE =

.PHONY: demo test test-lowest lint docs bench real compare mutants profile paper nightly weekend lock audit clean system

demo: $(VENV)/.demo
	@BIN=$(BIN) OUT=$(OUT) sh .ci/demo

# All tests but the slow ones; weekend runs these, too. The types are checked beside them: that takes one core.
# FOLDER=stitching: those of tests/stitching alone.
FOLDER ?=
TESTS = tests/$(patsubst tests/%,%,$(FOLDER))
PYTEST = OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"
test: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@$(BIN)/mypy >$(VENV)/mypy.log 2>&1 & types=$$!; \
	$(PYTEST) $(TESTS); tests=$$?; \
	wait $$types; types=$$?; cat $(VENV)/mypy.log; exit $$((tests || types))

# All tests but the slow ones with the oldest versions that pyproject.toml allows. Those warn of what is new since.
test-lowest:
	$(MAKE) VENV=.venv-lowest DEPENDENCIES=lowest .venv-lowest/.test
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 .venv-lowest/bin/python -m pytest -n 2 --dist worksteal -m "not slow" \
		-W ignore::DeprecationWarning -W ignore::PendingDeprecationWarning

lint: $(VENV)/.test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/mypy

# docs/parameters.md, docs/schemas and docs/pictures/rooms.svg from the code; the rest of docs/ is written by hand.
docs: $(VENV)/.test
	$(BIN)/python -m docs.scripts.make_parameters
	$(BIN)/python -m docs.scripts.make_schemas
	$(BIN)/python -m docs.scripts.make_rooms

bench: $(VENV)/.test
	$(BIN)/python -m pip install --quiet --editable ".[designgen,test,bench]"
	$(BIN)/python -m tests.bench.m3c2 --output $(OUT)/bench-m3c2.json
	$(BIN)/python -m tests.bench.spheres.peers --output $(OUT)/bench-peers-spheres.json
	$(BIN)/python -m tests.bench.bolt_balls --cases frame-1040 --seeds 1 --output $(OUT)/bench-frame-1040.json
	$(BIN)/processor papers -o $(OUT)/bench-papers --only 001 --seeds 1
	$(BIN)/python -m tests.bench.generator --whole --output $(OUT)/bench-generator.json
	$(BIN)/python -m tests.bench.readers --speed --output $(OUT)/bench-readers.json
	$(BIN)/python -m tests.bench.start --output $(OUT)/bench-start.json
	$(BIN)/python -m tests.bench.cost --output $(OUT)/bench-cost.json

# Real data that is on the machine, see docs/real.md: what was measured, against what, how far. Exit code 4: one is outside.
real: $(VENV)/.test
	$(BIN)/python -m tests.real.measured --output $(OUT)/real.json

# Results of this code held against stored ones of the same scenes: see tests/bench/comparer. Without a reference one is
# made, of the code as it is: make it before a change. COMPARE="--time 3" judges the time as well.
REFERENCE ?= $(OUT)/reference
COMPARE ?=
compare: $(VENV)/.test
	test -e $(REFERENCE)/reference.json || $(BIN)/python -m tests.bench.comparer references -o $(REFERENCE) --jobs $(JOBS)
	$(BIN)/python -m tests.bench.comparer compare $(REFERENCE) --jobs $(JOBS) -o $(OUT)/comparison.json $(COMPARE)

# Small errors put into the numeric code, one at a time: which of them does no test see? SEED draws others.
NUMBER ?= 200
SEED ?= 1
mutants: $(VENV)/.test
	$(BIN)/python -m tests.mutation --number $(NUMBER) --seed $(SEED) --jobs $(JOBS) -o $(OUT)/mutants

# Processor time of the tests by folder, file, test and fixture.
profile: $(VENV)/.test
	rm -rf $(OUT)/suite-times
	SUITE_TIMES=$(OUT)/suite-times $(PYTEST) -q -p tests.bench.suite $(TESTS)
	SUITE_TIMES=$(OUT)/suite-times $(BIN)/python -m tests.bench.suite

paper: $(VENV)/.demo
	@BIN=$(BIN) OUT=$(OUT) sh .ci/paper
	$(BIN)/processor papers -o $(OUT)/papers --jobs $(JOBS)

# Exit code 4: a limit was missed; 6: a figure got worse. --again replaces a run of today by other software.
nightly: $(VENV)/.demo
	$(BIN)/processor validate -o $(OUT)/nightly --jobs $(JOBS) --again

weekend: $(VENV)/.test paper
	$(BIN)/processor validate --smallest -o $(OUT)/smallest --jobs $(JOBS)
	$(BIN)/processor validate -o $(OUT)/nightly --jobs $(JOBS) --again --full
	$(BIN)/python -m pytest -n 2 --cov --cov-report=term --cov-fail-under=85
	$(BIN)/python -m tests.bench.bolt_balls --output $(OUT)/nightly-bolt-balls.json
	$(BIN)/python -m tests.bench.readers --mutations 2000 --output $(OUT)/nightly-damaged-files.json
	$(BIN)/python -m tests.bench.soak --minutes 60 --output $(OUT)/nightly-soak.json

# The versions of .ci/locked.txt and .ci/lowest.txt again; rm .ci/locked.txt first for the newest ones.
UV = $(BIN)/uv pip compile --quiet --no-strip-extras --custom-compile-command "make lock" --python-version 3.10
WITH = --extra designgen --extra test pyproject.toml .ci/build.in
lock: | $(BIN)/python
	$(BIN)/python -m pip install --quiet uv
	$(UV) --universal --generate-hashes $(WITH) -o .ci/locked.txt
	$(UV) --resolution lowest-direct $(WITH) -o .ci/lowest.txt

# Known vulnerabilities of the locked versions.
audit: | $(BIN)/python
	$(BIN)/python -m pip install --quiet pip-audit
	$(BIN)/pip-audit --require-hashes --disable-pip --requirement .ci/locked.txt

system:
	@sh .ci/system-libraries

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: pyproject.toml .ci/system-libraries | $(BIN)/python
	@sh .ci/system-libraries
	$(BIN)/python -m pip install --quiet --editable ".[designgen]"
	@touch $@

$(VENV)/.test: pyproject.toml .ci/system-libraries .ci/browser .ci/install | $(BIN)/python
	@sh .ci/system-libraries
	@sh .ci/browser
	BIN=$(BIN) sh .ci/install $(DEPENDENCIES)
	@touch $@ $(VENV)/.demo

clean:
	rm -rf $(VENV) .venv-lowest $(OUT) build *.egg-info .coverage .pytest_cache .mypy_cache .ruff_cache
	find processor designgen -name "*.nb[ci]" -delete
