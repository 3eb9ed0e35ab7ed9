# Every command first makes .venv if it is missing or older than pyproject.toml or constraints.txt.
PYTHON ?= python3
JOBS ?= 2
ARGS ?=

bin := .venv/bin
stamp := .venv/.installed
# Several processes share the machine: one thread each.
one_thread := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1
# Kernels of an older processor, which round differently.
older := OPENBLAS_CORETYPE=Nehalem GLIBC_TUNABLES=glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F
# One file, one process: module fixtures that fit a memory are made once.
pytest = $(one_thread) $(bin)/python -m pytest -n $(JOBS) --dist loadfile

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo reproduce doctor test test-all test-floats extras matrix soak check format docs wheel clean

help: ## list the commands
	@sed -nE 's/^([a-z-]+):.* ## (.*)/  make \1\t\2/p' Makefile | expand -t 20
	@echo "Variables: PYTHON=$(PYTHON) makes .venv, JOBS=$(JOBS) test processes, ARGS goes to demo, reproduce and pytest."

demo: $(stamp) ## run the demonstration; ARGS=--help lists its options
	@$(bin)/asm-gym demo $(ARGS)

reproduce: $(stamp) ## run the studies of the method's claims; ARGS=--quick to see that they run
	@for study in memorise_and_recall repertoire panda harm chunks; do $(bin)/asm-gym reproduce $$study $(ARGS) || exit; done

doctor: $(stamp) ## say what this machine lacks, and the command that installs it
	@$(bin)/asm-gym doctor

test: $(stamp) ## run the tests that take seconds
	$(pytest) -m "not slow" $(ARGS)

test-all: $(stamp) ## run every test, slow ones too
	$(pytest) $(ARGS)

test-floats: $(stamp) ## run experts and closed loops with the rounding of an older processor
	$(older) $(pytest) -m "floats and not slow" $(ARGS)

extras: $(stamp) ## install every extra in a fresh environment and run its tests; ARGS=learners for one
	$(one_thread) $(bin)/python -m tests.extras $(ARGS)

matrix: $(stamp) ## run `make test` in fresh environments of every Python and NumPy; needs uv; ARGS="'3.13 numpy>=2'" for one
	$(bin)/python -m tests.extras matrix $(ARGS)

soak: $(stamp) ## kill commands at random moments, and run the hypothesis machines a hundred times longer
	$(one_thread) $(bin)/python -m tests.kills $(ARGS)
	SOAK=100 $(pytest) tests/test_fuzz_machines.py

check: $(stamp) ## check formatting, lint and types
	$(bin)/ruff format --check .
	$(bin)/ruff check .
	$(bin)/mypy

format: $(stamp) ## format the code, and fix lint
	$(bin)/ruff check --fix .
	$(bin)/ruff format .

docs: $(stamp) ## build the documentation in docs/_build/html
	rm -rf docs/reference/api
	$(bin)/python -m sphinx -b html -W --keep-going -q docs docs/_build/html
	@echo "make: open docs/_build/html/index.html"

wheel: ## build the source archive, and from it the wheel, in dist/
	@$(PYTHON) -m venv --clear build/venv
	@build/venv/bin/python -m pip install --quiet --disable-pip-version-check build
	@build/venv/bin/python -m build --outdir dist . >build/log || { cat build/log >&2; exit 1; }
	@tail -n 1 build/log

clean: ## remove .venv, builds and caches; runs/ stays
	rm -rf .venv build dist docs/_build docs/reference/api docs/reference/commands.md *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

pip := $(bin)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
# The environment was finished once, and its Python still runs.
usable := test -f $(stamp) && $(bin)/python -c '' 2>/dev/null

$(stamp): pyproject.toml constraints.txt
	@$(usable) || command -v $(PYTHON) >/dev/null || \
	  { echo "make: there is no $(PYTHON); on Debian: apt-get install python3 python3-venv" >&2; exit 1; }
	@$(usable) || $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "make: asm-gym needs Python 3.11 or newer, and $(PYTHON) is $$($(PYTHON) -V 2>&1);" \
	         "name another: make PYTHON=python3.13" >&2; exit 1; }
	@$(usable) || $(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
	  { echo "make: $(PYTHON) cannot make a virtual environment; on Debian: apt-get install python3-venv" >&2; exit 1; }
	@$(usable) || $(PYTHON) -m venv --clear .venv
	@echo "make: installing into .venv, which takes minutes the first time" >&2
	@$(pip) -e '.[dev]' && $(pip) --no-deps robosuite || { echo "make: the install failed" >&2; exit 1; }
	@touch $@
	@$(bin)/asm-gym warmup >&2
