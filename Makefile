# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
# make demo and make test set up all they need; the rest is listed by make help.
VENV := .venv
RUN := $(VENV)/bin/python
READY := $(VENV)/.ready
BROWSER := $(VENV)/.browser
OUT ?= out

.PHONY: help demo train-demo train test test-system lint size docs format bench fuzz fuzz-files soak endings benchmark colcon clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*##/\t/' | expand -t 14

$(READY): tools/setup setup.py $(wildcard requirements/*.txt)
	tools/setup $(VENV)

$(BROWSER): $(READY)
	tools/setup $(VENV) browser

demo: $(READY)  ## place cameras with real ROS nodes: make demo [ROOM=scan.ply] [CAMERAS=4] [HEIGHT=1.9] [SCALE=1.0] [UP=z] [DROP_NONFINITE=1] [MODEL=actor]
	$(RUN) -m ocp_ros.demo.demo --out "$(OUT)" $(if $(ROOM),--room "$(ROOM)") $(if $(CAMERAS),--cameras $(CAMERAS)) $(if $(HEIGHT),--height $(HEIGHT)) $(if $(SCALE),--scale $(SCALE)) $(if $(UP),--up $(UP)) $(if $(DROP_NONFINITE),--drop-nonfinite) $(if $(MODEL),--model $(MODEL))

train-demo: $(READY)  ## the same with trainer_node, which sends new weights to every policy_node: make train-demo [PAIRS=1] [TURNS=400]
	$(RUN) -m ocp_ros.demo.train_demo --out "$(OUT)" $(if $(PAIRS),--pairs $(PAIRS)) $(if $(TURNS),--turns $(TURNS))

train: $(READY)  ## train the shipped model again
	$(RUN) -m ocp_ros.cli.main train --config config/train/actor.yaml --out "$(OUT)/train" --model models/actor.safetensors --overwrite

# A test whose process dies is run once more and told as a rerun (test/conftest.py says why one may
# die); a test that fails, fails.
TEST := $(RUN) -m pytest -n auto --maxprocesses 4 --dist worksteal --reruns 1 --only-rerun "no failure"

test: $(READY)  ## run the tests, on up to four cores; the whole-system drills are in make test-system
	$(TEST) -m "not system"

test-system: $(BROWSER)  ## run the drills of whole systems: soak, training demo, Ray cluster, interrupted nodes
	$(TEST) -m system

lint: $(READY)  ## check style, by the rules of ament_flake8, ament_pep257 and ament_copyright, and types
	$(VENV)/bin/ruff check .
	$(VENV)/bin/flake8 ocp_ros benchmarks examples test launch setup.py
	$(VENV)/bin/mypy

size:  ## how large the package is; an error where it is above the bar
	tools/size

docs: $(READY)  ## build the documentation as a site in OUT/docs, out/docs unless named; a broken link is an error
	$(RUN) -m pip install --quiet --disable-pip-version-check -r requirements/docs.txt
	$(RUN) -m sphinx -W --keep-going -q -b html docs "$(OUT)/docs"

format: $(READY)  ## fix what ruff can fix
	$(VENV)/bin/ruff check --fix .

bench: $(READY)  ## measure accuracy and speed of the engine, of the nodes and of training over ROS, for docs/results
	$(RUN) -m benchmarks.engine --preset full --record
	$(RUN) -m benchmarks.docs.visibility_picture --out docs/visibility.png
	$(RUN) -m benchmarks.drills.node_bench --record

# RECORD=1 also writes the figures of a drill to docs/results.
RECORDED := $(if $(RECORD),--record)

fuzz: $(READY)  ## send malformed messages to nodes: make fuzz [MESSAGES=100000, or MINUTES=10 in their place]
	$(RUN) -m benchmarks.drills.fuzz --out "$(OUT)" $(RECORDED) $(if $(MESSAGES),--messages $(MESSAGES)) $(if $(MINUTES),--minutes $(MINUTES))

fuzz-files: $(READY)  ## read files with errors in them, of every format: make fuzz-files [FILES=2000]
	$(RUN) -m benchmarks.drills.file_fuzz --out "$(OUT)" $(RECORDED) $(if $(FILES),--mutations $(FILES))

soak: $(READY)  ## play, kill nodes and send malformed messages: make soak [MINUTES=5] [KILLS=100, in place of minutes]
	$(RUN) -m benchmarks.drills.soak --out "$(OUT)" $(RECORDED) $(if $(MINUTES),--minutes $(MINUTES)) $(if $(KILLS),--kills $(KILLS))

endings: $(READY)  ## end nodes in all usual ways and count crashes: make endings [ENDINGS=500]
	$(RUN) -m benchmarks.drills.endings --out "$(OUT)/endings" $(RECORDED) $(if $(ENDINGS),--endings $(ENDINGS))

benchmark: $(READY)  ## compare all planners in all test rooms: twenty minutes on two idle cores; continues an interrupted run
	$(RUN) -m ocp_ros.cli.main benchmark --preset full --seeds 1 --out "$(OUT)/benchmark"
	$(RUN) -m benchmarks.benchmark_report "$(OUT)/benchmark" --record benchmark

colcon: $(READY)  ## build with colcon and start the installed nodes once
	tools/check_install $(VENV)

clean:  ## remove everything that can be made again
	rm -rf $(VENV) build install log $(OUT) *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +
