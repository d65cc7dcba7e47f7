# make demo   set up .venv and run the main job: replay an attack and watch it being blocked
# make test   set up .venv and run the tests
# make venv   set up .venv alone
# make check  ruff, mypy, import rules
# make docs   the documentation as a site, in site/
# make reference   the pages and the picture of the documentation that are made from the code
# make coverage    the tests, and which lines they do not reach
# make dist   sdist, wheels, bill of materials and checksums in dist/; runs the demo from the wheel
# make p4     compile p4/sdnator.p4 again (needs p4c)

PYTHON ?= python3
VENV := .venv
# optional parts of pyproject.toml to install: `make EXTRAS=dev,spark test` tests the Spark engine too
EXTRAS ?= dev
# how many workers share the tests (tests/conftest.py says how); 0: one after the other
WORKERS ?= 3
PYTEST := -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder
BIN := $(VENV)/bin
comma := ,
BASE := $(VENV)/.set-up
STAMP := $(BASE)-$(subst $(comma),-,$(EXTRAS))
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check

.PHONY: venv demo test check docs reference coverage dist p4 clean
.DEFAULT_GOAL := test

venv: $(STAMP)

# The stamps hold what the environment was made from: a second run does nothing.
$(BASE): pyproject.toml $(wildcard setup.py apps/*/*.[ch] apps/*/*/*.[ch])
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "SDNator needs Python 3.11 or later; $(PYTHON) is `$(PYTHON) -V 2>&1`. Try: make PYTHON=python3.11" >&2; exit 2; }
	@echo "==> setting up $(VENV) (once; takes a minute or two)"
	@$(PYTHON) -m venv $(VENV) \
	  || { echo "Python cannot make virtual environments here; on Debian: apt install python3-venv" >&2; exit 2; }
	@$(PIP_INSTALL) --upgrade pip
	@$(PIP_INSTALL) --editable .
	@touch $@

$(STAMP): $(BASE)
	@echo "==> adding what tests and documentation need ($(EXTRAS))"
	@$(PIP_INSTALL) --editable '.[$(EXTRAS)]'
	@touch $@

demo: $(BASE)
	@$(BIN)/sdnator demo

test: venv
	@echo "==> tests"
	@$(BIN)/python $(PYTEST)

check: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy due coordinator apps dataplane sdnator p4rt benchmarks examples sdnator_due.py

docs: venv
	$(BIN)/mkdocs build --strict

reference: venv
	$(BIN)/python -m sdnator.reference docs

coverage: venv
	COVERAGE_FILE=$(CURDIR)/.coverage $(BIN)/python -m coverage run $(PYTEST)
	$(BIN)/python -m coverage combine --quiet
	$(BIN)/python -m coverage report --skip-covered

dist: $(BASE)
	@$(PIP_INSTALL) --editable '.[release]'
	@$(BIN)/python deploy/make_dist.py

p4: venv
	$(BIN)/python -m sdnator.p4_program compile

clean:
	rm -rf $(VENV) build dist *.egg-info demo site
