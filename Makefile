# The two commands of the README are `make demo` and `make test`. Both need python3 (3.11 to 3.14) and nothing else.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --quiet --disable-pip-version-check

.PHONY: demo check test lint types quick docs bench soundness fuzz readme picture people deviations lock clean

demo: $(VENV)/made
	@$(BIN)/hrcreplay demo

# By two processes, for two cores; see tests/conftest.py.
PROCESSES ?= 2
test: lint types
	$(BIN)/pytest --numprocesses $(PROCESSES)

# Format, lint, types and the quick tests, which tests/conftest.py lists; types and tests at the same time.
check: lint
	@$(MAKE) --no-print-directory --jobs 2 types quick

lint: $(VENV)/made
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: $(VENV)/made
	$(BIN)/mypy

quick: $(VENV)/made
	$(BIN)/pytest --quick --numprocesses $(PROCESSES)

# The documentation as a site that needs no network, with a search and the API; see mkdocs.yml. Prints the page to open.
docs: $(VENV)/made
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict
	@echo "$(CURDIR)/.docs-site/index.html"

bench: $(VENV)/made
	$(BIN)/pytest tests/benchmarks --benchmark-only

# Looks for a motion of the person that leaves the volumes of a method, on all cores.
SAMPLES ?= 1000000
METHOD ?= sound
LIMITS ?= people
soundness: $(VENV)/made
	$(BIN)/python -m tests.tools.soundness --samples $(SAMPLES) --method $(METHOD) --limits $(LIMITS) --processes $(shell nproc)

# Measures every figure of the README anew where sources changed, and writes them into it; see tests/tools/readme. It goes on
# where it was broken off. ONLY='"demo,"' measures what begins so; recordings by others are those in $HRCREPLAY_DATA.
ONLY ?=
readme: $(VENV)/made
	$(BIN)/python -m tests.tools.readme $(ONLY)

# Draws docs/demo.webp, the README's moving picture, from a stretch of the demo.
picture: $(VENV)/made
	$(BIN)/python -m tests.tools.picture

# Fits hrcreplay/limits/people.toml again, byte for byte, to the recordings by others in $HRCREPLAY_DATA and to simulated
# people who get up and sit down; tells what each recording that was left out gave.
people: $(VENV)/made
	$(BIN)/python -m tests.tools.people

# Compares the deviations in state.parquet with errors against the truth and against smoothed recordings (docs/deviations.md), and
# fits their constants anew; exit code 5 where these are not those in the code.
deviations: $(VENV)/made
	$(BIN)/python -m tests.tools.deviations

# Spoils logs at random and puts them through the commands: no traceback, no other exit code, nothing half-written.
LOGS ?= 500
LIVE ?= 100
SEED ?= 1
fuzz: $(VENV)/made
	$(BIN)/python -m tests.tools.fuzz --logs $(LOGS) --live $(LIVE) --seed $(SEED)

# Everything from the lock, by hash and without a compiler; then the project itself, its kernels compiled in two processes.
$(VENV)/made: requirements.lock pyproject.toml
	@echo "Building $(VENV): one to seven minutes, once."
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) --require-hashes --only-binary :all: -r requirements.lock
	@$(PIP) --no-deps --no-build-isolation --editable .
	@$(BIN)/hrcreplay warmup
	@touch $@

# Needs uv. Writes versions and hashes, never an index's address.
lock:
	uv pip compile --quiet --universal --generate-hashes --fork-strategy fewest --no-emit-index-url --python-version 3.11 \
		--extra dev --custom-compile-command 'make lock' pyproject.toml --output-file requirements.lock

clean:
	rm -rf $(VENV) .mypy_cache .pytest_cache .ruff_cache .benchmarks .docs-site
