# Everything runs in .venv, which the first target that needs it makes; nothing else on the machine changes.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
RUN ?= runs/demo

.PHONY: demo test interop interop-tools lint clean
.DELETE_ON_ERROR:

demo: $(STAMP)
	$(BIN)/dsar train embedded --preset demo --minutes 6.3 --out $(RUN) $(if $(wildcard $(RUN)/checkpoint),--resume)
	$(BIN)/dsar export $(RUN) --usd $(RUN)/out.usda --ply $(RUN)/ply
	$(BIN)/dsar render $(RUN) --exr $(RUN)/exr --mp4 $(RUN)/out.mp4

# Two files of tests at a time, the slow ones (tests/train) before the quick.
test: $(STAMP)
	$(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder --durations 25

# Blender, a splat converter and a web viewer of others, in which our files are tried; about 1.3 GB.
interop: $(STAMP)
	-$(MAKE) -k interop-tools
	$(BIN)/pytest tests/interop -rs

interop-tools: .interop/.blender .interop/.node

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright

clean:
	rm -rf .venv .interop runs dist .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Blender's module wants an older numpy than we do, so it gets an environment of its own.
.interop/.blender:
	@echo "Setting up Blender in .interop"
	@$(PYTHON) -m venv .interop/blender
	@.interop/blender/bin/pip install -qq 'bpy==4.5.15' 'numpy<2'
	@touch $@

.interop/.node:
	@echo "Setting up a splat converter and a viewer in .interop"
	@mkdir -p .interop
	@npm install --prefix .interop --silent --no-save --no-audit --no-fund --ignore-scripts \
	  @playcanvas/splat-transform@2.7.1 @sparkjsdev/spark@2.2.0 three@0.187.0 playwright-core@1.65.1
	@touch $@

# torch first and alone: a CPU wheel that pip already knows of, else the one on PyTorch's own index.
$(STAMP): pyproject.toml constraints.txt
	@echo "Setting up .venv (about a minute)"
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@$(BIN)/pip install -qq -c constraints.txt torch 2>/dev/null || \
	  $(BIN)/pip install -qq -c constraints.txt --extra-index-url https://download.pytorch.org/whl/cpu torch
	@$(BIN)/pip install -qq -c constraints.txt -e '.[dev]'
	@touch $@
