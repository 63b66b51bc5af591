# `make` lists the targets. Settings are given on the command line, not through the environment:
# what runs is what was typed.

SEED = 0
TASK = visual_dot_reacher
STEPS = $(if $(filter dot_reacher,$(TASK)),5000,7000)
MODE = local_only
NETWORK =
RUN_DIR =
SIZE = small
PYTHON =

python = .venv/bin/python

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help demo test test-stable-baselines3 check bench soak study-min-time study-modes format environment lock clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "  make %-23s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo
	@echo "  make demo [SEED=0] [TASK=visual_dot_reacher] [STEPS=7000] [MODE=local_only] [NETWORK=] [RUN_DIR=]"
	@echo "  Every target that runs Python makes .venv/ first; PYTHON= chooses its interpreter (3.11 or 3.12)."

demo: environment ## learn a task through all four services, live
	$(python) -m deploy.launch $(MODE) --task $(TASK) --steps $(STEPS) --seed $(SEED) \
	  $(if $(NETWORK),--network $(NETWORK)) $(if $(RUN_DIR),--run-dir $(RUN_DIR))

check: environment ## format, lint, types and import rules; edits nothing
	$(python) -m ruff format --check .
	$(python) -m ruff check .
	$(python) -m mypy
	.venv/bin/lint-imports

test: environment ## run every test
	$(python) -m pytest

test-stable-baselines3: ## train a stock learner on a task through Gymnasium, in an environment of its own
	@PYTHON='$(PYTHON)' deploy/bootstrap/environment.sh sync .venv-sb3 tests/stable_baselines3/requirements.lock
	.venv-sb3/bin/python tests/stable_baselines3/train.py

bench: environment ## measure every speed and size that has a budget; fail if one is exceeded
	$(python) -m benchmarks.bench

soak: environment ## run for 21 minutes; fail if memory or open files grow
	$(python) -m benchmarks.soak

study-min-time: environment ## learn under several time limits; resumable; SIZE=small (within an hour) or thesis
	$(python) -m experiments.minimum_time --size $(SIZE)

study-modes: environment ## learn in several modes, in virtual time; resumable; SIZE=glance, small or ppo (two hours each), thesis, or real (in real time)
	$(python) -m experiments.distribution --size $(SIZE)

format: environment ## format the code and fix what the linter can
	$(python) -m ruff check --fix --exit-zero .
	$(python) -m ruff format .

environment: ## make or renew .venv/ from requirements.lock
	@PYTHON='$(PYTHON)' deploy/bootstrap/environment.sh sync

lock: ## write requirements.lock anew from pyproject.toml
	@PYTHON='$(PYTHON)' deploy/bootstrap/environment.sh lock

clean: ## remove the environment and the tools' caches; runs/ stays
	rm -rf .venv .venv-sb3 .uv .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
