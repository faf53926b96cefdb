# knee_gap: two commands, `make demo` and `make test`; both set up whatever is missing.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup anatomy training demo test lint bench faults clean

help: ## show what there is
	@sed -n 's/^\([a-z]*\):.*## /  make \1\t/p' $(MAKEFILE_LIST)

setup: ## set up whatever is missing
	@tools/setup

anatomy: setup ## add what knees of meshes need (make_bag --anatomy)
	@tools/env sh -c 'uv pip install -q --python "$$(command -v python)" --require-hashes -r tools/requirements/anatomy.lock'

training: setup ## add what train_segmentation needs (JAX)
	@tools/env sh -c 'uv pip install -q --python "$$(command -v python)" --require-hashes -r tools/requirements/training.lock'

demo: setup ## play the sample bag through the live nodes; results in out/demo
	@tools/run knee_gap_bringup demo

test: setup ## run all tests: of units on two cores, then of processes one after the other
	@tools/env python -m pytest --numprocesses 2 --dist loadfile test/unit; units=$$?; \
	tools/env python -m pytest test/system && exit $$units

lint: setup ## ruff, mypy
	@tools/env ruff check .
	@tools/env ruff format --check .
	@tools/env mypy

bench: setup ## measure speed and memory, as ratios against named floors and rivals
	@tools/env python bench/bench.py

faults: setup ## do to the live nodes what happens in an operating room, and print what came of it
	@tools/env python bench/bench_live_faults.py

clean: ## remove everything that was set up, built or written
	rm -rf .venv build install log out
