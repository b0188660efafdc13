# make help lists what there is; another interpreter: make test PYTHON=python3.12
PYTHON ?=
ARGS ?=
# Test processes; each takes a ROS domain of its own. Two more than cores: tests of nodes mostly wait.
WORKERS ?= $(shell expr $$(nproc) + 2)
# Only every so many of the tests of make coverage.
EVERY ?= 1
# Cases of make fuzz.
N ?= 2000
VENV = bash tools/venv.sh
RUN = bash tools/run.sh

.PHONY: demo test ubuntu fuzz coverage check docs format venv clean help

demo: ## the real node on a recorded flight, with a fault on the way
	@$(VENV) "watch,logs,calibrate" "$(PYTHON)" compile
	@$(RUN) python -c 'import rclpy' || { echo "make demo needs ROS 2 Jazzy: source /opt/ros/jazzy/setup.bash first"; exit 1; }
	@$(RUN) python examples/demo.py $(ARGS)

test: venv ## all tests
	@$(RUN) python -m fdi_ros.cli compile
	@$(RUN) python -m pytest -n $(WORKERS) --dist worksteal $(ARGS)

ubuntu: ## what flies, with no more than a live node needs and in the versions of Ubuntu 24.04
	@bash tools/ubuntu.sh $(ARGS)

fuzz: venv ## N hostile files, recordings and command lines: make fuzz N=20000
	@$(RUN) python -m fdi_ros.cli compile
	@FUZZ_CASES=$(N) $(RUN) python -m pytest -n $(WORKERS) -o faulthandler_timeout=60 test/bag/test_limits.py -k hostile_file $(ARGS)

# Tests that a trace cannot see into, or that it would slow down most: nodes, machine code, simulated flights.
UNSEEN = test/ros test/core test/detectors test/monitor test/replay test/mavlink/test_failover.py test/mavlink/test_policy.py \
    test/test_package.py test/test_readme.py test/test_libraries.py

coverage: venv ## share of the lines of Python that the quicker tests run, without nodes and compiled code
	@$(RUN) python -m fdi_ros.cli compile
	@$(RUN) python -m pip install --quiet pytest-cov
	@mkdir -p build
	@$(RUN) python -m pytest --collect-only $(UNSEEN:%=--ignore=%) | awk '/::/ && n++ % $(EVERY) == 0' > build/covered
	@test -s build/covered
	@$(RUN) python -m pytest -n $(WORKERS) --dist worksteal --cov=fdi_ros @build/covered $(ARGS)

check: venv ## style and types
	@$(RUN) python -m ruff check .
	@$(RUN) python -m ruff format --check .
	@if $(RUN) python -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then $(RUN) python -m mypy; else \
	    echo "types not checked: the last NumPy for Python 3.10 states the shapes of arrays too narrowly; take 3.11 or newer"; fi

docs: ## this project's pages and API reference as a site in build/docs; warnings and dead links are errors
	@$(VENV) "watch,logs,calibrate,cluster,test,docs" $(PYTHON)
	@rm -rf build/docs
	@$(RUN) python -m sphinx -q -W --keep-going -d build/doctrees -b html docs build/docs
	@echo "wrote build/docs/index.html"

format: venv ## mend what style can mend
	@$(RUN) python -m ruff check --fix .
	@$(RUN) python -m ruff format .

venv: ## .venv with all that tests and checks need
	@$(VENV) "watch,logs,calibrate,cluster,test" $(PYTHON)

clean: ## remove .venv and all that was built
	rm -rf .venv .venv-ubuntu build install log *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis

help: ## this list
	@awk -F ':[^#]*## ' '/^[a-z]+:[^#]*## / { printf "make %-8s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
