# Everything runs in .venv, which the first target that needs it makes; nothing else on the machine changes.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
RUN ?= runs/demo

.PHONY: demo test lint clean
.DELETE_ON_ERROR:

demo: $(STAMP)
	$(BIN)/dsar train embedded --preset demo --minutes 6.3 --out $(RUN) $(if $(wildcard $(RUN)/checkpoint),--resume)
	$(BIN)/dsar export $(RUN) --usd $(RUN)/out.usda --ply $(RUN)/ply
	$(BIN)/dsar render $(RUN) --exr $(RUN)/exr --mp4 $(RUN)/out.mp4

test: $(STAMP)
	$(BIN)/pytest

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright

clean:
	rm -rf .venv runs dist .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# torch first and alone: a CPU wheel that pip already knows of, else the one on PyTorch's own index.
$(STAMP): pyproject.toml constraints.txt
	@echo "Setting up .venv (about a minute)"
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@$(BIN)/pip install -qq -c constraints.txt torch 2>/dev/null || \
	  $(BIN)/pip install -qq -c constraints.txt --extra-index-url https://download.pytorch.org/whl/cpu torch
	@$(BIN)/pip install -qq -c constraints.txt -e '.[dev]'
	@touch $@
