# `make demo` and `make test` set everything up by themselves; neither needs root.
# An active virtual or conda environment is used as it is; otherwise .venv is made.
.PHONY: setup dev demo table test pyright pytest reliability house results docs clean

ENVIRONMENT := $(or $(VIRTUAL_ENV),$(CONDA_PREFIX),$(CURDIR)/.venv)
BIN := $(ENVIRONMENT)/bin
# A file's tests share what they build, so each file stays on one process; the longest begin first (conftest.py).
PARALLEL := --numprocesses=auto --maxprocesses=4 --dist=loadfile --no-loadscope-reorder
STAMP := $(ENVIRONMENT)/.hyaline-installed
DEV_STAMP := $(STAMP)-dev

setup: $(STAMP)

PIP := $(BIN)/python -m pip install $(if $(CI),--quiet) --disable-pip-version-check --no-compile -c $(ENVIRONMENT)/hyaline-constraints.txt
# PyTorch of PyPI for Linux brings CUDA libraries of 4 GB; uv knows where a build without them is.
NEEDS_CPU_TORCH := [ "$$(uname)" = Linux ] && ! command -v nvidia-smi >/dev/null && grep '^torch==' $(ENVIRONMENT)/hyaline-constraints.txt

# A torch that is there stays (its line is dropped from the constraints). All of a recipe is expanded as it begins.
$(STAMP): pyproject.toml constraints.txt
	@echo "setup: installs hyaline-glass[all] into $(ENVIRONMENT); downloads about 0.8 GB (2.2 GB on disk), and 4 GB"
	@echo "       of CUDA libraries where there is an NVIDIA GPU: minutes, depending on the network"
	@test -x $(BIN)/python || python3 -m venv $(ENVIRONMENT)
	@if $(BIN)/python -c "import torch" 2>/dev/null; then grep -v '^torch==' constraints.txt; else cat constraints.txt; fi \
		> $(ENVIRONMENT)/hyaline-constraints.txt
	@if torch=$$($(NEEDS_CPU_TORCH)); then \
		echo "setup: no NVIDIA GPU here, so PyTorch comes without CUDA"; \
		$(PIP) uv && UV_HTTP_TIMEOUT=20 $(BIN)/uv pip install --python $(BIN)/python --torch-backend=cpu "$$torch" || \
		! $(PIP) --quiet --no-deps --ignore-installed --dry-run --report - "$$torch" | grep -q '"\(cuda\|nvidia\)-' || \
		{ echo "setup: stopped, since pip would now download CUDA libraries of 4 GB; see docs/install.md"; exit 1; }; \
	fi
	$(PIP) -e ".[all]"
	@# pip would compile half a minute on one core; some libraries have files that cannot be compiled.
	@$(BIN)/python -m compileall -qq -j 0 "$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')" || true
	$(BIN)/datagen doctor
	@touch $@
	@echo "setup: took $$(( $$(date +%s) - $(shell date +%s) )) seconds"

# What `make test` needs, too.
dev: $(DEV_STAMP)

$(DEV_STAMP): $(STAMP)
	$(PIP) -e ".[dev]"
	@touch $@

# A first result: the glass table at 64 x 64 pixels, trained for about a minute of CPU time a run.
demo: setup
	$(BIN)/datagen build glass_table --preset small --spp 256 --test-spp 512 --workers 2 --out data/demo
	$(BIN)/proxies make demo --kind ellipsoid
	$(BIN)/model train paper demo --steps 800
	$(BIN)/model train paper-best demo --steps 800
	$(BIN)/model train paper demo --geometry ellipsoid --steps 800
	$(BIN)/model train light-path demo --steps 400
	$(BIN)/model export demo/light-path-400-steps --out runs/demo/light-path-400-steps/scene.html --overwrite
	$(BIN)/report

# The first seed of README's table, at 128 x 128 pixels, and README's picture of it: 20 to 30 CPU minutes.
table: setup
	$(BIN)/datagen build glass_table
	$(BIN)/proxies make glass_table --kind ellipsoid
	$(BIN)/model train paper glass_table
	$(BIN)/model train paper-best glass_table
	$(BIN)/model train paper glass_table --geometry ellipsoid
	$(BIN)/model train light-path glass_table
	$(BIN)/report
	$(BIN)/python docs/demo.py data/glass_table runs/glass_table docs/demo.webp

test: dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(MAKE) --no-print-directory --jobs=2 pyright pytest

# Pyright keeps one core busy for a minute; meanwhile the tests begin on the others.
pyright: dev
	$(BIN)/pyright

pytest: dev
	$(BIN)/python -m pytest $(PARALLEL) $(TESTS)

# Every promise of docs/reliability.md with every case, and what `make test` leaves out, an hour on two cores.
reliability: dev
	$(BIN)/python -m pytest $(PARALLEL) -m "promise or full" --full

# The lines of every room beside its budget (house.toml).
house: dev
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
