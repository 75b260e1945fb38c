# Everything is installed into .venv, but for system libraries that are missing.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= out
JOBS ?= 2
# Modules stay compiled, also where the environment says otherwise: tests and demo start many processes.
export PYTHONDONTWRITEBYTECODE =

.PHONY: demo test lint docs bench paper nightly weekend clean system

demo: $(VENV)/.demo
	@BIN=$(BIN) OUT=$(OUT) sh .ci/demo

# All tests but the slow ones; weekend runs these, too. The types are checked beside them: that takes one core.
test: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@$(BIN)/mypy >$(VENV)/mypy.log 2>&1 & types=$$!; \
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"; tests=$$?; \
	wait $$types; types=$$?; cat $(VENV)/mypy.log; exit $$((tests || types))

lint: $(VENV)/.test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/mypy

# docs/parameters.md from the code; the rest of docs/ is written by hand.
docs: $(VENV)/.test
	$(BIN)/python -m docs.make_parameters

bench: $(VENV)/.test
	$(BIN)/python -m pip install --quiet --editable ".[designgen,test,bench]"
	$(BIN)/python -m tests.bench.m3c2 --output $(OUT)/bench-m3c2.json
	$(BIN)/python -m tests.bench.peers_spheres --output $(OUT)/bench-peers-spheres.json
	$(BIN)/python -m tests.bench.bolt_balls --cases frame-1040 --seeds 1 --output $(OUT)/bench-frame-1040.json
	$(BIN)/processor papers -o $(OUT)/bench-papers --only 001 --seeds 1
	$(BIN)/python -m tests.bench.generator --whole --output $(OUT)/bench-generator.json
	$(BIN)/python -m tests.bench.readers --speed --output $(OUT)/bench-readers.json

paper: $(VENV)/.demo
	@BIN=$(BIN) OUT=$(OUT) sh .ci/paper
	$(BIN)/processor papers -o $(OUT)/papers --jobs $(JOBS)

# Exit code 4: a limit was missed or a figure got worse. --again replaces a run of today by other software.
nightly: $(VENV)/.demo
	$(BIN)/processor validate -o $(OUT)/nightly --jobs $(JOBS) --again

weekend: $(VENV)/.test paper
	$(BIN)/processor validate -o $(OUT)/nightly --jobs $(JOBS) --again --full
	$(BIN)/python -m pytest -n 2 --cov --cov-report=term --cov-fail-under=85
	$(BIN)/python -m tests.bench.bolt_balls --output $(OUT)/nightly-bolt-balls.json
	$(BIN)/python -m tests.bench.readers --mutations 2000 --output $(OUT)/nightly-damaged-files.json

system:
	@sh .ci/system-libraries

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: pyproject.toml .ci/system-libraries | $(BIN)/python
	@sh .ci/system-libraries
	$(BIN)/python -m pip install --quiet --editable ".[designgen]"
	@touch $@

$(VENV)/.test: pyproject.toml .ci/system-libraries .ci/browser | $(BIN)/python
	@sh .ci/system-libraries
	@sh .ci/browser
	$(BIN)/python -m pip install --quiet --editable ".[designgen,test]"
	@touch $@ $(VENV)/.demo

clean:
	rm -rf $(VENV) $(OUT) build *.egg-info .coverage .pytest_cache .mypy_cache .ruff_cache
	find processor designgen -name "*.nb[ci]" -delete
