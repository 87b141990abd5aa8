# Everything runs in .venv, made on first use: only Python >= 3.11 (with venv), make and git are needed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Hundreds of processes start in the tests: each would compile every module once more.
unexport PYTHONDONTWRITEBYTECODE
# Each worker takes what others have not begun: some tests take a second, some a millisecond.
PYTEST := $(BIN)/python -m pytest -n auto --dist worksteal

.PHONY: demo docs test test-further test-all test-fast check bench fuzz chaos endurance clean

# A full paper session on the simulated rig, then its analysis.
demo: $(VENV)/ready
	rm -rf demo
	$(BIN)/rigd run chirp --profile sim --fast --seed 1 --output demo
	$(BIN)/analyze demo/*.mcap --report demo/report
	@echo "The operator's page on the simulated rig: $(BIN)/rigd serve --profile sim --web --output demo"

# Seven minutes on two processors: every behaviour once.
test: $(VENV)/ready
	$(PYTEST) -m "not further and not slow"

# What is shown once more: over another transport, with other values, at more length.
test-further: $(VENV)/ready
	$(PYTEST) -m "further and not slow"

# Without what starts processes or fits models: a minute, for every edit.
test-fast: $(VENV)/ready
	$(PYTEST) -m "not slow and not browser and not process and not fit"

# All tests, also what is shown once more at full length.
test-all: $(VENV)/ready
	$(PYTEST)

# The documentation as a site, in build/site, and whether it is whole and complete without the internet.
docs: $(VENV)/docs-ready
	rm -rf build/site  # pages of modules that no longer exist
	$(BIN)/sphinx-build --fail-on-warning --keep-going --quiet -d build/doctrees docs build/site
	RIGD_SITE=build/site $(BIN)/python -m pytest -n 0 -q tests/docs/test_site.py
	@echo "The documentation: build/site/index.html"

check: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy plugins/rigd-netft/rigd_netft
	$(BIN)/lint-imports
	$(BIN)/python .ci/check_names.py
	$(BIN)/python .ci/check_imports.py

# Half an hour on two idle cores: an error if a row of a benchmark is beyond its limit.
bench: $(VENV)/ready
	$(BIN)/python benchmarks/run_all.py

# The long run of what the tests do briefly: other examples of each property, a million frames at
# each parser, 1200 damaged session files, 1000 that are hostile, and a hostile value for each option
# and key; an hour.
fuzz: $(VENV)/ready
	$(PYTEST) -m hypothesis --hypothesis-profile=others
	$(BIN)/python tests/devices/cia402/fuzz_cia402.py 1000000
	$(BIN)/python tests/devices/ati/fuzz_ati.py 1000000
	$(BIN)/python tests/sim/wire/drive/fuzz_drive_node.py 1000000
	$(BIN)/python tests/sim/wire/ati/fuzz_ati_nodes.py 1000000
	$(BIN)/python tests/recovery/fuzz_recovery.py 200
	$(BIN)/python tests/recovery/fuzz_hostile.py 1000
	$(BIN)/python tests/recovery/fuzz_options.py

# The processes of two hundred sessions killed, suspended and asked to end at random moments, each
# followed by another session: half an hour.
chaos: $(VENV)/ready
	$(BIN)/python tests/chaos/kill_rig.py

# Twelve hours of rig time under the virtual clock: ten minutes. Then ten minutes beside four busy
# programs, and a quarter of an hour of daemon, live view and page.
endurance: $(VENV)/ready
	$(BIN)/python tests/endurance/run_campaign.py
	$(BIN)/python tests/endurance/run_starved.py
	$(BIN)/python tests/endurance/run_served.py

$(VENV)/ready: pyproject.toml plugins/rigd-netft/pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "rigd needs Python 3.11 or newer; set PYTHON=/path/to/it")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --editable '.[all]' --editable plugins/rigd-netft --group dev
	touch $@

$(VENV)/docs-ready: $(VENV)/ready
	$(BIN)/python -m pip install --quiet --group docs
	touch $@

clean:
	rm -rf $(VENV) build demo
