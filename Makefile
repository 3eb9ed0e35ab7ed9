# Every command makes .venv first, when it is missing or older than pyproject.toml or constraints.txt.
PYTHON ?= python3
JOBS ?= 2
ARGS ?=

bin := .venv/bin
stamp := .venv/.installed
# Several processes share the machine: one thread each, or they slow each other down.
one_thread := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1
# The matrix products and the functions of an older processor, which round otherwise than this one's.
older := OPENBLAS_CORETYPE=Nehalem GLIBC_TUNABLES=glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F
# A file stays in one process: fixtures that fit a memory are made once.
pytest = $(one_thread) $(bin)/python -m pytest -n $(JOBS) --dist loadfile

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo reproduce doctor test test-all test-floats extras soak check format docs wheel clean

help: ## list the commands
	@sed -nE 's/^([a-z-]+):.* ## (.*)/  make \1\t\2/p' Makefile | expand -t 20
	@echo "Variables: PYTHON=$(PYTHON) makes .venv, JOBS=$(JOBS) test processes, ARGS goes to demo, reproduce and pytest."

demo: $(stamp) ## a robot that notices when something is wrong; ARGS=--help lists its options
	@$(bin)/asm-gym demo $(ARGS)

reproduce: $(stamp) ## the method's claims, each with a figure and a table; ARGS=--quick to see that they run
	@$(bin)/asm-gym reproduce all $(ARGS)

doctor: $(stamp) ## what this machine lacks, and the command that installs it
	@$(bin)/asm-gym doctor

test: $(stamp) ## the tests that take seconds
	$(pytest) -m "not slow" $(ARGS)

test-all: $(stamp) ## every test, those that take minutes too
	$(pytest) $(ARGS)

test-floats: $(stamp) ## experts and closed loops, where floating point rounds as on an older processor
	$(older) $(pytest) -m "floats and not slow" $(ARGS)

extras: $(stamp) ## every extra in a fresh environment, with the tests of what needs it; ARGS=learners for one
	$(one_thread) $(bin)/python -m tests.extras $(ARGS)

soak: $(stamp) ## kill commands at random moments, and run the hypothesis machines a hundred times longer
	$(one_thread) $(bin)/python -m tests.kills $(ARGS)
	SOAK=100 $(pytest) tests/test_fuzz_machines.py

check: $(stamp) ## formatting, lint and types
	$(bin)/ruff format --check .
	$(bin)/ruff check .
	$(bin)/mypy

format: $(stamp) ## formats the code, and fixes what lint can
	$(bin)/ruff check --fix .
	$(bin)/ruff format .

docs: $(stamp) ## this documentation as a site, in docs/_build/html
	$(bin)/python -m sphinx -b html -W --keep-going -q docs docs/_build/html
	@echo "make: open docs/_build/html/index.html"

wheel: $(stamp) ## the wheel and the source archive, in dist/
	$(bin)/python -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist .
	$(bin)/python -c "from setuptools.build_meta import build_sdist as b; print('make: dist/' + b('dist'))"

clean: ## removes .venv, builds and caches; runs/ stays
	rm -rf .venv build dist docs/_build docs/reference/api docs/reference/commands.md *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Still there, finished once, and its Python still runs: not interrupted half-way, nor left by a Python since removed.
usable := test -f $(stamp) && $(bin)/python -c '' 2>/dev/null

$(stamp): pyproject.toml constraints.txt
	@$(usable) || command -v $(PYTHON) >/dev/null || \
	  { echo "make: there is no $(PYTHON); on Debian: apt-get install python3 python3-venv" >&2; exit 1; }
	@$(usable) || $(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' || \
	  { echo "make: the environments need Python 3.11 or 3.12, and $(PYTHON) is $$($(PYTHON) -V 2>&1);" \
	         "name another: make PYTHON=python3.12" >&2; exit 1; }
	@$(usable) || $(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
	  { echo "make: $(PYTHON) cannot make a virtual environment; on Debian: apt-get install python3-venv" >&2; exit 1; }
	@$(usable) || $(PYTHON) -m venv --clear .venv
	@echo "make: installing into .venv, which takes minutes the first time" >&2
	@$(bin)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]' || \
	  { echo "make: the install failed. Where building evdev failed (robosuite needs it), on Debian:" \
	         "apt-get install gcc libc6-dev linux-libc-dev python3-dev" >&2; exit 1; }
	@touch $@
	@$(bin)/asm-gym warmup >&2
