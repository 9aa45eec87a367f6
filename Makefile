# `make demo` and `make test` set everything up by themselves; neither needs root.
# An active virtual or conda environment is used as it is; otherwise .venv is made.
.PHONY: setup demo test pyright pytest reliability house results docs clean

ENVIRONMENT := $(or $(VIRTUAL_ENV),$(CONDA_PREFIX),$(CURDIR)/.venv)
BIN := $(ENVIRONMENT)/bin
# A file's tests share what they build, so each file stays on one process; the longest begin first (conftest.py).
PARALLEL := --numprocesses=auto --maxprocesses=4 --dist=loadfile --no-loadscope-reorder
STAMP := $(ENVIRONMENT)/.hyaline-installed

setup: $(STAMP)

# A torch that is there stays (its line is dropped from the constraints).
$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || python3 -m venv $(ENVIRONMENT)
	@if $(BIN)/python -c "import torch" 2>/dev/null; then grep -v '^torch==' constraints.txt; else cat constraints.txt; fi \
		> $(ENVIRONMENT)/hyaline-constraints.txt
	@echo "setup: installs hyaline-glass[llvm,dev] and its libraries into $(ENVIRONMENT)"; \
	echo "setup: downloads about 0.8 GB, which take 2.2 GB on disk; minutes, depending on the network"; \
	if [ "$$(uname)" = Linux ] && ! command -v nvidia-smi >/dev/null && ! $(BIN)/python -c "import torch" 2>/dev/null; then \
		echo "setup: there is no NVIDIA GPU here. If pip brings CUDA libraries (4 GB more), press Ctrl-C and first run"; \
		echo "       $(BIN)/python -m pip install uv && $(BIN)/uv pip install --python $(BIN)/python --torch-backend=cpu torch==2.13.0"; \
	fi; \
	$(BIN)/python -m pip install $(if $(CI),--quiet) --disable-pip-version-check --no-compile \
		-c $(ENVIRONMENT)/hyaline-constraints.txt -e ".[llvm,dev]"
	@# pip would compile half a minute on one core; some libraries have files that cannot be compiled.
	@$(BIN)/python -m compileall -qq -j 0 "$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')" || true
	$(BIN)/datagen doctor
	@touch $@

demo: setup
	$(BIN)/datagen build --scene glass_table
	$(BIN)/proxies make glass_table --kind ellipsoid
	$(BIN)/model train paper data/glass_table
	$(BIN)/model train paper-best data/glass_table
	$(BIN)/model train paper data/glass_table --geometry ellipsoid
	$(BIN)/model train light-path data/glass_table
	$(BIN)/report

test: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(MAKE) --no-print-directory --jobs=2 pyright pytest

# Pyright keeps one core busy for a minute; meanwhile the tests begin on the others.
pyright: setup
	$(BIN)/pyright

pytest: setup
	$(BIN)/python -m pytest $(PARALLEL) $(TESTS)

# Every promise of docs/reliability.md with every case, and what `make test` leaves out, an hour on two cores.
reliability: setup
	$(BIN)/python -m pytest $(PARALLEL) -m "promise or full" --full

# The lines of every room beside its budget (house.toml).
house: setup
	$(BIN)/python tests/support/house.py

# docs/results/*.md and the tables of README, RESULTS and docs/{index,paper,claims}.md, from the stored results.json files.
results: setup
	for page in paper scenes fits; do $(BIN)/python docs/results.py docs/results/$$page > docs/results/$$page.md || exit 1; done
	$(BIN)/hyaline-bench leaderboard docs/results/bench > docs/results/bench.md
	$(BIN)/python docs/tables.py

# The pages of docs/ as a web site.
docs: setup
	$(BIN)/python -m pip install $(if $(CI),--quiet) --disable-pip-version-check -c constraints.txt -e ".[docs]"
	$(BIN)/mkdocs build --quiet
	@echo build/site/index.html

clean:
	rm -rf .venv *.egg-info
