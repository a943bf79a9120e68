PYTHON ?= python3
BIN := .venv/bin
comma := ,

.PHONY: docs house house-write tutorial case-studies case-studies-rates reproduce calibrate calibrate-quick calibrate-alignment \
	calibrate-alignment-quick calibrate-fit regime test test-quick test-all bench lint format clean

# matrices are small and work is divided among processes: further threads of BLAS would wait for each other
export OPENBLAS_NUM_THREADS ?= 1
export PYTHONDONTWRITEBYTECODE :=  # byte code is kept: one process compiles a module of Python, the others load it

# .venv/.lab: what `make reproduce` needs; .venv/.done: that, and what tests, documents and checks need
VENV_MISSING := $(PYTHON) cannot make a virtual environment, python3-venv is missing; on Debian and Ubuntu: apt install python3-venv
INSTALL ?= $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check
define install
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "$(VENV_MISSING)" >&2; exit 1; }
	$(PYTHON) -m venv .venv
	$(INSTALL) -c constraints.txt -e ".[$(1)]"
endef

.venv/.lab: pyproject.toml constraints.txt
	$(call install,bench$(comma)report)
	touch $@

.venv/.done: pyproject.toml constraints.txt
	$(call install,dev)
	touch $@ .venv/.lab

reproduce: .venv/.lab
	$(BIN)/consistency reproduce --overwrite

# what is in which tier: CONTRIBUTING.md
test-quick: .venv/.done
	$(BIN)/python -m pytest -n 2 --dist worksteal -m quick

test: .venv/.done
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow and not browser"

test-all: .venv/.done
	$(BIN)/python -m pytest -n 2 --dist worksteal --durations=40 --durations-min=5

calibrate: .venv/.done
	$(BIN)/python benchmarks/calibration.py \
		--out reports/reference/calibration.json --docs docs/reference/rates.md

calibrate-quick: .venv/.done
	$(BIN)/python benchmarks/calibration.py --quick

calibrate-alignment: .venv/.done
	$(BIN)/python benchmarks/alignment.py --docs docs/reference/rates.md

calibrate-alignment-quick: .venv/.done
	$(BIN)/python benchmarks/alignment.py --quick

calibrate-fit: .venv/.done
	$(BIN)/python benchmarks/fit_covariance.py
	$(BIN)/python benchmarks/fit_sides.py
	$(BIN)/python benchmarks/correct.py

RECURSIVE := ekf-uvd ukf-uvd parked-ekf-uvd robocentric-ekf-uvd anchored-ekf-uvd eqf-uvd ri-ekf-uvd fej-ekf-uvd oc-ekf-uvd \
	ckf-uvd iekf-uvd ispkf-uvd
regime: .venv/.done
	$(BIN)/consistency sweep regime $(addprefix --filter ,$(RECURSIVE)) --out reports/regime
	cp reports/regime/map.json reports/reference/regime.json
	$(BIN)/consistency sweep beyond --out reports/beyond
	cp reports/beyond/map.json reports/reference/beyond.json

case-studies:
	$(PYTHON) docs/case-studies/run.py $(ONLY)

case-studies-rates:
	$(PYTHON) docs/case-studies/run.py --rates $(ONLY)

docs: .venv/.done
	$(BIN)/python -m sphinx -q -E -W --keep-going -d docs/_build/doctrees docs docs/_build/html
	$(BIN)/python docs/check.py docs/_build/html

house:
	$(PYTHON) docs/house.py

house-write:
	$(PYTHON) docs/house.py --write

tutorial: .venv/.done
	$(BIN)/python docs/tutorial.py

bench: .venv/.done
	$(BIN)/python benchmarks/bench.py

# the types of the core are also checked for Python 3.10
CORE := $(addprefix consistency/,__init__.py referee commands diagnostics.py errors.py testing.py pytest_plugin.py)
lint: .venv/.done
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy
	$(BIN)/mypy --python-version 3.10 --follow-imports silent $(CORE)

format: .venv/.done
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf .venv .env-new .env-old dist build docs/_build docs/generated .pytest_cache .mypy_cache .ruff_cache
