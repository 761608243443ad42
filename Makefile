# `make demo` and `make test` are all a fresh clone needs; both set up .venv first.
PYTHON ?= python3
# Options for installing torch, for example an index that has the smaller CPU-only build; any build will do.
TORCH_OPTIONS ?=
# Options for pytest in `make test`, for example "--cpu 25": the 25 tests that take most processor time.
TEST_OPTIONS ?=
# Processes that run the tests; those of a folder stay together, so that they share what is made once.
TEST_WORKERS ?= 2
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.set-up
SOURCES := pyproject.toml constraints.txt CMakeLists.txt $(wildcard pipeline/kernels/src/* converters/simulate/render/src/*) $(wildcard pipeline/base/stand_ins/*.[ht]*)
SANITIZED := build/sanitize/.built
DEMO := outputs/demo
DOCS_VENV := build/docs-venv

# Commands of a recipe that needs a Python with venv.
define CHECK_PYTHON
@command -v $(PYTHON) >/dev/null || { echo "setup: $(PYTHON) not found; install Python 3.11 or later" >&2; exit 1; }
@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "setup: $$($(PYTHON) --version) found, Python 3.11 or later expected; set PYTHON=" >&2; exit 1; }
@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { echo "setup: Python module venv not found; on Debian: apt-get install python3-venv" >&2; exit 1; }
endef

.PHONY: help setup demo test golden docs bench lint format sanitize check-full fuzz clean
.DEFAULT_GOAL := help

help:
	@echo "make demo        set up, then simulate two robots, fuse their maps, evaluate, report ($(DEMO))"
	@echo "make test        set up, then run the tests, and print their processor time by folder"
	@echo "make golden      make the stored runs again and name every difference (minutes)"
	@echo "make lint        ruff, mypy and codespell"
	@echo "make docs        the site of the documentation, every link checked (build/site)"
	@echo "make bench       speed of the kernels, side by side with plain torch"
	@echo "make check-full  the slow checks as well, and the kernels under sanitizers (minutes)"
	@echo "make fuzz        5000 damaged files for every reader (an hour of one core)"

setup: $(STAMP)

$(STAMP): $(SOURCES)
	$(CHECK_PYTHON)
	@command -v c++ >/dev/null || { echo "setup: no C++ compiler found; on Debian: apt-get install g++" >&2; exit 1; }
	@$(PYTHON) -c 'import os, sys, sysconfig; sys.exit(not os.path.exists(os.path.join(sysconfig.get_paths()["include"], "Python.h")))' || { echo "setup: Python.h not found; on Debian: apt-get install python3-dev" >&2; exit 1; }
	$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(TORCH_OPTIONS) "torch==2.13.0"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[test,lint,dev]"
	@# with PYTHONDONTWRITEBYTECODE, every process of a run would compile its modules again
	$(BIN)/python -m compileall -q pipeline converters schemas
	touch $(STAMP)

demo: setup
	$(BIN)/duagc demo --out $(DEMO) --force

# A test that does not end is said, with what every thread was at, instead of being waited for.
test: setup
	$(BIN)/python -m pytest -m "not slow" -n $(TEST_WORKERS) --dist loadscope --no-loadscope-reorder -o faulthandler_timeout=300 -o faulthandler_exit_on_timeout=true $(TEST_OPTIONS)

# Four runs made again and compared, message by message, with what is stored under tests/golden.
golden: setup
	$(BIN)/python -m tests.golden.command check

# Nothing is imported, so the tools of the site need neither .venv nor the kernels.
docs: $(DOCS_VENV)/.set-up
	NO_MKDOCS_2_WARNING=1 $(DOCS_VENV)/bin/mkdocs build --strict

$(DOCS_VENV)/.set-up: pyproject.toml
	$(CHECK_PYTHON)
	$(DOCS_VENV)/bin/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(DOCS_VENV)
	$(DOCS_VENV)/bin/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["docs"], sep="\n")' > $(DOCS_VENV)/requirements.txt
	$(DOCS_VENV)/bin/python -m pip install --quiet --disable-pip-version-check -r $(DOCS_VENV)/requirements.txt
	touch $@

check-full: setup sanitize
	$(BIN)/python -m pytest

fuzz: setup
	$(BIN)/python -m tests.fuzz.run --count 5000

# The tests of the kernels with every access to memory and every operation checked. CPython itself leaks on purpose.
sanitize: setup $(SANITIZED)
	ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 \
	LD_PRELOAD="$$(c++ -print-file-name=libasan.so) $$(c++ -print-file-name=libstdc++.so)" \
	DUAGC_RASTER=$$(echo $(dir $(SANITIZED))duagc/pipeline/kernels/_raster*.so) \
	$(BIN)/python -m pytest --capture=sys -p tests.kernels.other_build -m "not slow" tests/kernels tests/registration/test_compiled.py

$(SANITIZED): $(SOURCES)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --upgrade --target $(dir $@) \
	  --config-settings=build-dir=$(dir $@)cmake --config-settings=cmake.define.DUAGC_SANITIZE=ON \
	  --config-settings=install.strip=false .
	touch $@

bench: setup
	$(BIN)/duagc bench raster

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/codespell

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf build pipeline/kernels/*.so converters/simulate/render/*.so pipeline/base/stand_ins/*.so $(STAMP)
