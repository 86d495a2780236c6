# Needs make and a Python 3.11 or 3.12; everything else is installed into .venv from the lock.
VENV := .venv
PYTHON := $(VENV)/bin/python
LOCK := requirements.lock
PIP := $(PYTHON) -m pip install -qq --disable-pip-version-check
# The lock is complete, so nothing is resolved again, and what has to be built is built with its
# setuptools.  Bytecode is made beside the model.
LOCKED := --require-hashes --no-deps --no-compile --no-build-isolation --use-pep517
install = ( for group in $(1); do $(PYTHON) scripts/lock_groups.py $$group > $(VENV)/part.txt \
	&& $(PIP) $(LOCKED) -r $(VENV)/part.txt || exit 1; done )
# Its wheels are of x86-64 alone; elsewhere a ROS of the system serves (docs/installation.md).
ROS := $(if $(filter x86_64,$(shell uname -m)),ros)
# Further groups for `make setup`: the extras of setup.py, as in WITH="export archive".
WITH := dashboard
# What the installation copies: a change here installs the package again (seconds).  It is a real
# installation, not an editable one, because only that one puts the executables, configs and bags
# where `ros2 run` and `ros2 launch` look.
INSTALLED := setup.py setup.cfg pyproject.toml package.xml $(shell find eha_monitor config launch \
	bags executables scripts resource -type f -not -name '*.pyc' 2>/dev/null)

# Trials that take an hour, by people who have not seen this project: proofs, not benchmarks.
TRIALS := $(addprefix benchmarks/,wrong_inputs.py first_minute.py)

# What the benchmarks write their figures with.
RECORDS := benchmarks/record.py benchmarks/tables.py benchmarks/proof_figures.py
# The trial on recordings from elsewhere: each is named, and takes minutes to an hour.
GROUNDS := benchmarks/grounds.py

# What decides names, motions and orders, and the examples that print them: the answers are the
# same on every processor.  Linear algebra has other kernels on each, and a processor of which
# nothing is known gets other code for the model; it is compiled for it first.
DECIDING := $(addprefix test/,test_ties.py test_advise.py test_api_examples.py test_name_gram.py \
	test_name_rank.py)
GENERIC := $(addprefix test/,test_ties.py test_advise.py test_api_examples.py test_name_select.py)

# ROS traffic stays on this machine, in a domain of its own, and logs stay in out/.
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST
export ROS_DOMAIN_ID := $(shell echo $$(( $$$$ % 90 + 10 )))
export ROS_LOG_DIR ?= $(CURDIR)/out/ros_log

.DEFAULT_GOAL := help
.PHONY: help setup everything demo ring test test-machines test-generic lint bench figures reference notebook proof lock clean

help:
	@echo "make demo    simulator and monitor live, a replay, two HTML reports; installs what it needs"
	@echo "make ring    a false alarm, an experiment, a model adopted and taken back, live"
	@echo "make test    the test suite"
	@echo "make test-machines  what decides answers, as on other processors"
	@echo "make setup   .venv for the commands; WITH=\"export archive\": with these extras of setup.py"
	@echo "make everything  .venv with all of requirements.lock (make test and the others do it)"
	@echo "make lint    ruff"
	@echo "make bench   benchmarks, with their tables"
	@echo "make figures the tables of README and docs, of what the benchmarks recorded"
	@echo "make reference docs/api.md, of the docstrings"
	@echo "make notebook  docs/notebook.ipynb, executed again"
	@echo "make proof   the concealed-effect trial"
	@echo "make lock    requirements.lock anew from setup.py (needs uv)"
	@echo "make clean   remove .venv and everything built"

# What each target installs of the lock: `demo` the groups core and ros, `setup` those of WITH as
# well, `test` and the others all.  A stamp is written only when everything before it worked, so a
# broken set-up is done again.
$(VENV)/.compiler: $(LOCK) setup.py scripts/lock_groups.py
	@PYTHON3="$(PYTHON3)" sh scripts/make_venv.sh $(VENV)
	@echo "installing into $(VENV) what compiles the model ..."
	@$(call install,builds compiles)
	@touch $@

# The rest goes in while the compiler works on what a live monitor needs.
$(VENV)/.package: $(VENV)/.compiler $(INSTALLED)
	@rm -rf build/lib build/bdist.*  # else modules that are gone would be installed again
	@rm -rf $(VENV)/share/eha_monitor/compiled  # of other source
	@echo "installing what every command needs, and compiling (half a minute, once) ..."
	@$(PYTHON) -m eha_monitor.compile_all --live & \
		$(call install,core $(ROS)) && $(PIP) --no-deps --no-build-isolation --force-reinstall .; \
		done=$$?; wait $$! && exit $$done
	@touch $@

$(VENV)/.compiled: $(VENV)/.package
	@echo "compiling the rest of the model (half a minute to a minute, for each new source) ..."
	@# The packages' bytecode meanwhile, without their tests.  -P: what is installed, not the
	@# checkout.
	@$(PYTHON) -m compileall -q -x '/tests?/' $(VENV)/lib >/dev/null 2>&1 & \
		$(PYTHON) -P -m eha_monitor.compile_all --ship; done=$$?; wait; exit $$done
	@touch $@

$(VENV)/.all: $(VENV)/.compiler
	@echo "installing all other packages of the lock (a minute or two, once) ..."
	@$(PIP) $(LOCKED) -r $(LOCK)
	@touch $@

setup: $(VENV)/.compiled
	@$(call install,$(WITH))

everything: $(VENV)/.all $(VENV)/.compiled

# It compiles the rest itself, behind its first steps.
demo: $(VENV)/.package
	@PYTHONPATH=$(CURDIR) $(PYTHON) scripts/demo.py

ring: $(VENV)/.compiled
	@PYTHONPATH=$(CURDIR) $(PYTHON) scripts/ring.py

test: export ROS_PYTHON_CHECK_FIELDS := 1
test: everything
	@$(PYTHON) -m pytest -n 2 --dist loadfile --durations=10

test-machines: everything
	@failed=0; for kernel in Haswell Prescott; do echo "== OPENBLAS_CORETYPE=$$kernel"; \
		OPENBLAS_CORETYPE=$$kernel $(PYTHON) -m pytest -q -n 2 --dist loadfile $(DECIDING) \
		|| failed=1; done; exit $$failed

test-generic: everything  # compiles for a plain x86-64 first: minutes
	@export NUMBA_CPU_NAME=generic; \
		$(PYTHON) -P -m eha_monitor.compile_all && \
		$(PYTHON) -m pytest -q -n 2 --dist loadfile $(GENERIC)

lint: $(VENV)/.all
	@$(PYTHON) -m ruff check .

bench: everything
	@for file in $(filter-out $(TRIALS) $(RECORDS) $(GROUNDS),$(wildcard benchmarks/*.py)); do \
		echo "== $$file"; $(PYTHON) $$file || exit 1; done

figures: everything
	@$(PYTHON) benchmarks/tables.py

reference: everything
	@$(PYTHON) scripts/make_api_reference.py

notebook: everything
	@$(PYTHON) scripts/make_notebook.py

proof: everything
	@$(PYTHON) -m eha_monitor prove
	@for file in $(TRIALS); do echo "== $$file"; $(PYTHON) $$file || exit 1; done
	@$(PYTHON) -m pytest -m slow
	@$(PYTHON) -m pytest -n 2 --dist loadfile --hypothesis-profile fresh
	@$(MAKE) --no-print-directory test-generic

# The lock names no index, so it installs from whichever index pip is configured for.  fmpy asks for
# lark, and ROS for lark-parser, its former name with the same module: one of them is installed.
lock: export OVERRIDES := lark ; sys_platform == 'none'
lock:
	@mkdir -p out && echo "$$OVERRIDES" > out/overrides.txt
	uv pip compile --quiet setup.py --extra ros --extra dashboard --extra foxglove \
		--extra archive --extra dask --extra export --extra test --extra colcon --universal \
		--overrides out/overrides.txt \
		--python-version 3.11 --generate-hashes --no-emit-index-url \
		--custom-compile-command "make lock" --output-file $(LOCK)

clean:
	rm -rf $(VENV) build install log out *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
