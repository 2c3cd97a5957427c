# Every target runs in .venv, which the first of them makes. What a user needs (RUNS) and what a
# developer needs besides (READY) are installed apart: the demo needs no development tool.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUNS := $(VENV)/.runs
READY := $(VENV)/.ready
# Compiled by all processors afterwards: pip takes one.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile
COMPILE := $(BIN)/python -m compileall -qq -j 0 $(VENV)/lib || true

# Tests and builds start many processes; each compiles all modules again where none may be kept.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
SERVED := $(VENV)/.served
.PHONY: help serve install lock newest check format test test-real test-all test-changed demo bench reports docs docs-outputs pictures golden release clean

help: ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

$(RUNS): pyproject.toml packages/lab/pyproject.toml lock.txt
	@$(PYTHON) -c 'import sys; assert sys.version_info >= (3, 11), "starcat needs Python 3.11 or newer"'
	@echo "making $(VENV) and installing starcat with its libraries (900 MB; a minute or two)"
	@$(PYTHON) -m venv $(VENV)
	@sed '/^# --- service/,$$d' lock.txt > $(VENV)/run.txt
	@$(PIP) --require-hashes --no-deps --requirement $(VENV)/run.txt
	@$(PIP) --no-deps --no-build-isolation --editable . --editable packages/lab
	@$(COMPILE)
	@touch $(RUNS)

$(SERVED): $(RUNS) packages/service/pyproject.toml lock.txt
	@echo "installing what the service needs into $(VENV) (30 MB)"
	@sed '/^# --- dev/,$$d' lock.txt > $(VENV)/service.txt
	@$(PIP) --require-hashes --no-deps --requirement $(VENV)/service.txt
	@$(PIP) --no-deps --no-build-isolation --editable packages/service
	@$(COMPILE)
	@touch $(SERVED)

$(READY): $(RUNS) packages/service/pyproject.toml lock.txt
	@echo "installing the tools of the tests into $(VENV) (another 900 MB; a minute)"
	@$(PIP) --require-hashes --no-deps --requirement lock.txt
	@$(PIP) --no-deps --no-build-isolation --editable packages/service
	@$(COMPILE)
	@touch $(READY)

# The C matcher is compiled again after its sources change. A source that does not compile stops the
# tests, while an installation goes on without the C matcher.
BOUND := $(VENV)/.bound
C_FILES := $(wildcard onboard/src/*.[ch] onboard/include/*.h binding/*)
$(BOUND): $(READY) $(C_FILES)
	@if [ -z "$$STARCAT_WITHOUT_C" ] && command -v $${CC:-cc} >/dev/null; then \
		$(BIN)/python binding/build.py; \
	else echo "no C compiler: tests of the C matcher are skipped"; fi
	@touch $(BOUND)

BUILT_WITH := $(BIN)/python -c 'import tomllib; \
	print("\n".join(tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"]))'
SERVICE_NEEDS := $(BIN)/python -c 'import tomllib; \
	needs = tomllib.load(open("packages/service/pyproject.toml", "rb"))["project"]["dependencies"]; \
	print("\n".join(need for need in needs if not need.startswith("starcat")))'
LOCK := $(BIN)/uv pip compile --quiet --universal --generate-hashes --no-annotate \
	--no-emit-index-url --custom-compile-command 'make lock' --python-version 3.11 pyproject.toml -
lock: $(READY) ## renew lock.txt: the newest versions within the bounds, with their hashes
	$(BUILT_WITH) | $(LOCK) --upgrade --all-extras -o $(VENV)/all.txt
	$(BUILT_WITH) | $(LOCK) --extra images -c $(VENV)/all.txt -o $(VENV)/run.txt
	{ $(BUILT_WITH); $(SERVICE_NEEDS); } | $(LOCK) --extra images -c $(VENV)/all.txt -o $(VENV)/service.txt
	$(BIN)/python tools/lock.py $(VENV)/all.txt $(VENV)/run.txt $(VENV)/service.txt > lock.txt

newest: ## test with the newest versions that the bounds allow, in an environment of its own
	$(PYTHON) -m venv --clear .venv-newest
	.venv-newest/bin/python -m pip install --quiet --editable '.[dev]' --editable packages/lab --editable packages/service
	.venv-newest/bin/python -m pytest -q -n 2 --dist loadfile -m 'not slow and not real'

install: $(READY) ## install starcat and its tools into .venv

check: $(READY) ## format, lint, types
	$(BIN)/ruff format --check --quiet .
	$(BIN)/ruff check --quiet .
	$(BIN)/mypy --num-workers 2

format: $(READY) ## rewrite the code in the house format
	$(BIN)/ruff format --quiet .
	$(BIN)/ruff check --quiet --fix .

test: $(BOUND) ## the fast tests and the docstrings' examples; they need nothing but this folder
	$(BIN)/python -m pytest -q -n 2 --dist loadfile -m 'not slow and not real' \
		--durations 25 --durations-min 0.5

test-real: $(BOUND) ## the fast tests with real records and photographs, where their folders are
	$(BIN)/python -m pytest -q -n 2 --dist loadfile -m 'real and not slow'

test-all: $(BOUND) ## all tests, with new random examples; real data is used if its folders are there
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --hypothesis-profile new-examples

BASE ?= HEAD~1
test-changed: $(BOUND) ## the slow tests in the test files that changed since BASE (HEAD~1)
	@changed=$$(git diff --name-only --diff-filter=d $(BASE) -- 'tests/*/test_*.py' 'packages/*/tests/test_*.py' || true); \
	if [ -z "$$changed" ]; then echo "no test file changed since $(BASE)"; exit 0; fi; \
	$(BIN)/python -m pytest -q -n 2 --dist loadfile -m slow $$changed || [ $$? -eq 5 ]

demo: $(RUNS) ## build a database from the embedded sky, check it, identify simulated fields
	$(BIN)/starcat build --preset gaia-12deg --output dist --replace
	$(BIN)/starcat verify dist/gaia-12deg-1.0.0
	$(BIN)/starcat sql dist/gaia-12deg-1.0.0 --named emptiest-fields --set count=3
	$(BIN)/starcat simulate dist/gaia-12deg-1.0.0 --output dist/frame.csv --seed 7
	$(BIN)/starcat identify dist/gaia-12deg-1.0.0 dist/frame.csv
	$(BIN)/starcat selftest dist/gaia-12deg-1.0.0 --frames 500
	@echo "made: dist/gaia-12deg-1.0.0, a database whose report is report/index.html, and dist/frame.csv"
	@echo "go on with:"
	@echo "  $(BIN)/starcat identify dist/gaia-12deg-1.0.0 dist/frame.csv --picture dist/frame.png"
	@echo "  $(BIN)/starcat init dist/mycam.toml --size 1280x960 --fov-x-deg 16   a database of your camera"
	@echo "  make serve                                                       the same in a browser"

serve: $(SERVED) ## run the service at http://127.0.0.1:8000 with the embedded sky
	$(BIN)/starcat serve --root dist/service

BENCHMARKS := ingest products matcher instructions hostile false_matches fields sql votable
bench: $(BOUND) ## time and memory beside bare parsers and other star trackers, in one run
	@failed=; for name in $(BENCHMARKS); do \
		$(BIN)/python benchmarks/$$name.py || failed="$$failed $$name"; done; \
	if [ "$$failed" ]; then echo "benchmarks that failed:$$failed"; exit 1; fi

reports: $(READY) ## measure the files of a release in dist/reports: five papers, ECSS (an hour)
	$(BIN)/starcat evaluate --paper all --output dist/evaluation $(INPUTS)
	$(BIN)/python tools/reproduction.py
	$(BIN)/starcat evaluate --ecss-example > dist/reports/sensor.toml
	for preset in gaia-12deg sao-12deg; do \
		$(BIN)/starcat build --preset $$preset --output dist && \
		$(BIN)/starcat evaluate dist/$$preset-1.0.0 --ecss dist/reports/sensor.toml --frames 100 -o dist/reports || exit 1; done

docs: $(READY) ## build the site in dist/docs
	$(BIN)/sphinx-build -W --keep-going -q -b html docs dist/docs

docs-outputs: $(READY) ## run the commands of the documentation and write their outputs into the pages (ten minutes)
	$(BIN)/python tools/page_outputs.py

pictures: $(READY) ## draw the pictures of the documentation again
	$(BIN)/python tools/figures.py

golden: $(READY) ## rewrite the golden digests; look at the difference before committing it
	$(BIN)/python tools/golden.py
	@git --no-pager diff --stat tests/golden

release: $(READY) ## list new schemas in schemas/RELEASED.sha256; a listed one never changes
	$(BIN)/python tools/release_schemas.py

clean: ## remove what the targets made
	rm -rf $(VENV) dist build .mypy_cache .ruff_cache .pytest_cache .hypothesis
