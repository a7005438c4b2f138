# make env, make demo, make test: nothing but Python >= 3.11 and make is needed.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.ready
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
# Several times as fast; pip, which brings it, does what it cannot: a mirror that pip alone was told of.
UV := VIRTUAL_ENV=.venv $(BIN)/uv --quiet --no-progress pip install

# Without byte code the daemon would compile the dialect at each start.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: env demo test unit lint bench lock train-env train-test clean

env: $(STAMP)

$(STAMP): requirements.lock pyproject.toml hatch_build.py mavlink_dialect/nff.xml mavlink_dialect/generate.py
	$(PYTHON) -m venv .venv
	sed -n '/^uv==/,/[^\\]$$/p' requirements.lock > .venv/uv.lock
	$(PIP) --require-hashes -r .venv/uv.lock
	$(UV) --require-hashes -r requirements.lock || $(PIP) --require-hashes -r requirements.lock
	$(PIP) --no-deps --no-build-isolation -e .
	$(BIN)/python mavlink_dialect/generate.py > /dev/null 2>&1
	$(BIN)/python -m sitl.trials.warm_up
	touch $(STAMP)

demo: env
	$(BIN)/nff demo

# Each phase runs whatever became of the others.
lint: env
	@status=0; \
	$(BIN)/ruff check . || status=1; \
	$(BIN)/ruff format --check . || status=1; \
	$(BIN)/mypy || status=1; \
	exit $$status

# The quick tests alone: what neither flies nor waits.
unit: env
	$(BIN)/python -m pytest tests/unit -n 2 --dist worksteal

test: env
	@status=0; \
	$(MAKE) --no-print-directory lint || status=1; \
	$(BIN)/python -m pytest -m realtime || status=1; \
	$(BIN)/python -m pytest -m 'not realtime' -n 2 --dist worksteal || status=1; \
	exit $$status

bench: env
	$(BIN)/python benchmarks/check.py

# Pins every dependency of every extra but train; run after a change of pyproject.toml.
lock: env
	$(BIN)/uv pip compile pyproject.toml --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-header \
		--extra sim --extra dev --extra build -o requirements.lock

# Several GB: the training of networks alone needs it.
train-env: env
	$(UV) -e '.[train]' || $(PIP) -e '.[train]'

train-test: train-env
	$(BIN)/python -m pytest -m train

clean:
	rm -rf .venv build dist *.egg-info
