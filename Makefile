# make setup   makes .venv with exactly the versions of constraints.txt, and finds or installs what the system must have
# make setup-optional   sets up, and adds what contains GPL code: PyMeshLab, with which `gnmreg capture check` reports the
#                       topology of scans, and pycolmap, with which tests compare the COLMAP reader
# make demo    sets up, makes a head model and a capture from nothing, and registers it: about five minutes
# make demo-batch   a population of five in three expressions each, and two rounds of coregistration over it with two workers: quarter of an hour
# make check   sets up, then style, types and import directions
# make test    sets up, checks and runs the tests, two files at a time
# make test-durability   kills workers, drivers and a PostgreSQL server under load: minutes, not part of make test
#
# Needs git, make and Python 3.11 to 3.13. PYTHON=python3.12 names one; an existing .venv keeps the one it was made with.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:

BIN := .venv/bin
DEMO := build/demo
BATCH := build/demo_batch
DURABILITY := build/durability.txt
PYTHONS := $(or $(PYTHON),python3.13 python3.12 python3.11 python3)
INSTALLED := .venv/installed-$(shell cat pyproject.toml constraints.txt | sha256sum | cut -c1-16)
IN_RANGE := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))
PIP := $(BIN)/python -m pip --disable-pip-version-check install --constraint constraints.txt

# $(call packages,NAMES): root on Debian or Ubuntu gets them; false for anyone else
packages = { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get update -q \
	&& DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends $(1); }

.PHONY: setup set-up setup-optional demo demo-batch check test test-durability

# One at a time: the second of two that start at once waits, then finds everything there.
setup:
	@if command -v flock >/dev/null; then
		exec 9>.setup.lock
		flock -n 9 || { echo "another make setup runs here: waiting for it"; flock 9; }
	fi
	$(MAKE) --no-print-directory set-up

set-up: $(INSTALLED)
	@$(BIN)/python -m registration.render.llvm --install

setup-optional: setup
	@$(PIP) --only-binary=:all: --no-build-isolation --editable '.[mesh,colmap]'
	lacking() { $(BIN)/python -c 'import pymeshlab' 2>&1 | grep -oE 'lib[^ (:]+: cannot open shared object|.*Error: .*' | sort -u || true; }
	[ -z "$$(lacking)" ] || $(call packages,libgl1 libopengl0) || true
	if [ -n "$$(lacking)" ]; then
		echo "PyMeshLab cannot start:"
		lacking
		echo "To have it: sudo apt-get install -y libgl1 libopengl0"
		exit 1
	fi

demo: setup
	@rm -rf $(DEMO)
	set -x
	$(BIN)/gnmreg model bootstrap --out $(DEMO)/model/gnm_head_first.npz
	$(BIN)/gnmreg capture synth $(DEMO)/capture --seed 8 --shirt
	$(BIN)/gnmreg register $(DEMO)/capture --model $(DEMO)/model/gnm_head_first.npz --recipe draft --out $(DEMO)/registration
	$(BIN)/gnmreg evaluate $(DEMO)/registration --capture $(DEMO)/capture
	{ set +x; } 2>/dev/null
	echo "Look at $(DEMO)/registration/report.html"

demo-batch: setup
	@rm -rf $(BATCH)
	set -x
	$(BIN)/gnmreg model bootstrap --out $(BATCH)/first/gnm_head_first.npz
	$(BIN)/gnmreg dataset synth $(BATCH)/dataset --subjects 5 --held-out 2 --expressions smile,jaw_open --views 8 --size 256 256 --jobs 2
	$(BIN)/gnmreg coregister $(BATCH)/dataset --local --workers 2 --recipe draft --iterations 2 --all-iterations --model $(BATCH)/first/gnm_head_first.npz --components 5 10 --out $(BATCH)/rounds
	$(BIN)/gnmreg status --folder $(BATCH)/rounds.farm
	{ set +x; } 2>/dev/null
	echo "$$SECONDS seconds. Look at $(BATCH)/rounds/index.html and $(BATCH)/rounds/it01/model/index.html"

check: setup
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

test: check
	export OMP_NUM_THREADS=$$(( ($$(getconf _NPROCESSORS_ONLN) + 1) / 2 ))
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

test-durability: setup
	@ls /usr/lib/postgresql/*/bin/initdb >/dev/null 2>&1 || command -v initdb >/dev/null || $(call packages,postgresql) || {
		echo "No PostgreSQL here. On Debian and Ubuntu: sudo apt-get install -y postgresql" >&2
		exit 1
	}
	rm -f $(DURABILITY)
	GNMREG_DURABILITY=$(DURABILITY) $(BIN)/python -m pytest -m durability tests/workflows
	cat $(DURABILITY)

$(INSTALLED): .venv/bin/python
	@rm -f .venv/installed-*
	$(PIP) pip setuptools
	$(PIP) --only-binary=:all: --no-build-isolation --editable '.[dev]'
	touch $@

.venv/bin/python:
	@chosen= bare=
	for python in $(PYTHONS); do
		"$$python" -c '$(IN_RANGE)' 2>/dev/null || continue
		bare=$${bare:-$$python}
		"$$python" -c 'import ensurepip' 2>/dev/null || continue
		chosen=$$python; break
	done
	if [ -z "$$bare" ]; then
		echo "No Python 3.11, 3.12 or 3.13 here (looked for: $(PYTHONS)). Install one, or name it: make PYTHON=..." >&2
		exit 1
	fi
	if [ -z "$$chosen" ]; then
		package=python$$("$$bare" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv
		$(call packages,$$package) || {
			echo "$$bare lacks its venv module. On Debian and Ubuntu: sudo apt-get install -y $$package" >&2
			exit 1
		}
		chosen=$$bare
	fi
	"$$chosen" -m venv --clear .venv
