"""Files and numbers that are damaged, wrong or hostile: one line that names the file, and from a verb nothing is written."""

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch

from ftl_lightning.data.formats import files
from ftl_lightning.domains.from_file import read_demonstrations
from ftl_lightning.domains.registry import load_domain
from ftl_lightning.evaluation.results import COLUMNS, read_rows
from ftl_lightning.igm import concept
from ftl_lightning.igm.concept import Concept
from ftl_lightning.services.configuration import load
from ftl_lightning.services.tensor_file import file_hash
from ftl_lightning.training.checks import check_concept
from ftl_lightning.training.concept_model import ConceptModel
from ftl_lightning.training.model_folder import load_model

from .conftest import CONF, ROOT, refused
from .test_mistakes import refusal

Told = pytest.CaptureFixture[str]
PUSH = "go to red object"
MERGE = ["sample", "--pretrained=driving", "--compose=merge"]
ZERO = "0" * 16


def damaged(read: Callable[[str], object], path: str, *expected: str) -> None:
    """Read a file, and expect one line that says something."""
    with refusal(*expected):
        read(path)


def at(tree: dict[str, Any], path: str, value: object) -> dict[str, Any]:
    """A copy of a mapping with one value in it changed; ``...`` removes it."""
    tree = json.loads(json.dumps(tree))
    holder = tree
    *above, last = path.split(".")
    for key in above:
        holder = holder[key]
    holder[last] = value
    if value is ...:
        del holder[last]
    return tree


def nested(depth: int) -> Any:
    return json.loads("[" * depth + "0" + "]" * depth)


# A pretrained model's configuration


def model(source: str, text: str) -> None:
    """A folder ``model`` with a shipped model's weights and this configuration."""
    Path("model").mkdir()
    Path("model/model.safetensors").symlink_to(ROOT / "pretrained" / source / "model.safetensors")
    Path("model/config.json").write_text(text, encoding="utf-8", errors="surrogatepass")


DRIVING = json.loads((ROOT / "pretrained/driving/config.json").read_text())
CONFIGS: list[tuple[str, object, str]] = [
    *(("format", value, "format") for value in (3, True, ...)),
    ("hash", ..., "key 'hash': expected a text, found None"),
    ("hash", 7, "key 'hash': expected a text, found 7"),
    ("hash", ZERO, "expected the hash 0000000000000000"),
    ("kind", "gan", "key 'kind': expected one of diffusion"),
    *((key, value, f"key '{key}': expected a text") for key, value in (("kind", ["diffusion"]), ("domain", {}))),
    ("kind", "bc", "config.json: key 'denoiser'"),
    ("domain", "nowhere", "domain: expected one of"),
    ("domain", "json:loads", "asks for code, 'json:loads', that no installed package offers: it was not imported"),
    ("domain", "agent", "agent"),
    ("horizon", "8", "key 'horizon': expected a whole number from 0 to 1000000, found '8'"),
    *(("horizon", value, "key 'horizon'") for value in (8.0, True, -8, 10**9)),
    ("horizon", 0, "horizon: expected a number from 1"),
    ("horizon", 10**6, "horizon: expected a number from 1 to 10000"),
    *((key, value, "larger network") for key, value in (("horizon", 8000), ("concept_dim", 10**6))),
    *((f"denoiser_args.{key}", 10**6, "larger network") for key in ("depth", "hidden_dim")),
    ("horizon", ..., "key 'horizon': expected a value, found none"),
    ("state_dim", 8, "key 'state_dim': expected 7 (domain driving), found 8"),
    ("concept_dim", 383, "expected float32 (383,), found float32 (384,)"),
    *((key, value, f"key '{key}'") for key, value in (("concept_dim", None), ("encoder", ["x"]), ("view", 3), ("denoiser", 3))),
    ("training_concepts", "merge", "key 'training_concepts': expected a list"),
    ("training_concepts", ["merge", 3], "key 'training_concepts[1]': expected a text, found 3"),
    ("training_concepts", [], "training_embeddings"),
    ("training_concepts", ["\ud800"] * 4, "Unicode"),
    ("view", "sideways", "model.view: expected one of"),
    ("perturb", "yes", "key 'perturb': expected true or false, found 'yes'"),
    ("metrics", {"accuracy": "high"}, "key 'metrics.accuracy': expected a finite number"),
    ("metrics", {"accuracy": float("nan")}, "expected finite numbers, found nan"),
    *((f"observed{key}", value, f"key 'observed{key}': expected a mapping") for key, value in (("", []), (".traffic", 35))),
    ("observed.traffic.shape", 35, "key 'observed.traffic.shape': expected a list"),
    ("observed.traffic.shape", [10**6, 10**6], "observed"),
    ("observed.traffic.kind", "sound", "key 'observed.traffic.kind': expected one of 'vector', 'image'"),
    ("observed.traffic.entities", [[0, 1], [2]], "entities"),
    ("observed.traffic.entities", [[35]], "entities: expected columns from 0 to 34"),
    ("observed.traffic.state", [99], "state: expected columns"),
    ("observed.traffic.state", [0, 1], "state: expected 7 columns, found 2"),
    *((key, 1, f"key '{key}': expected one of") for key in ("observed.traffic.more", "unknown", "denoiser_args.width")),
    ("image_dim", 10, "image_dim"),
    ("training", nested(60), "deep"),
    ("denoiser", "Transformer", "denoiser: expected one of"),
    ("denoiser_args", [1], "key 'denoiser_args': expected a mapping"),
    *(("denoiser_args.depth", value, "key 'denoiser_args.depth'") for value in (10_000_000, "4")),
    ("denoiser_args.depth", 5, "does not fit config.json"),
    ("denoiser_args.hidden_dim", nested(3), "key 'denoiser_args.hidden_dim'"),
    ("denoiser_args.initial_encoder", "x" * 500, "denoiser_args.initial_encoder"),
    ("diffusion_steps", 0, "config.json"),
    ("diffusion_steps", 99, "alpha_bar"),
    ("prediction", "future", "prediction: expected one of"),
]


@pytest.mark.parametrize(("path", "value", "expected"), CONFIGS, ids=lambda value: str(value)[:40])
def test_a_configuration_of_a_model(path: str, value: object, expected: str) -> None:
    model("driving", json.dumps(at(DRIVING, path, value)))
    damaged(load_model, "model", "model/", expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "expected JSON"),
        *((text, "format") for text in ("[]", "null")),
        ('{"format": 2, "format": 2}', "key 'format': expected it once"),
        ("[" * 100_000, "too deep"),
        ('{"format": 2, "hash": 1e999}', "finite"),
        ('{"format": 2, "horizon": ' + "9" * 5000 + "}", "expected JSON"),
        (json.dumps(DRIVING)[:-1], "expected JSON"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_a_configuration_that_is_no_json(text: str, expected: str) -> None:
    model("driving", text)
    damaged(load_model, "model", "model/config.json", expected)


@pytest.mark.parametrize(
    ("kind", "path", "value"),
    [
        *(("in_context", key, value) for key, value in (("layers", 100_000), ("heads", 0), ("stride", 0))),
        *(("bc", key, value) for key, value in (("members", 10**6), ("members", 0), ("hidden_dim", 10**6))),
        *(("cvae", "hidden_dim", value) for value in ([512], 511)),
    ],
)
def test_a_configuration_of_a_baseline(kind: str, path: str, value: object) -> None:
    source = f"baseline/{kind}/driving"
    model(source, json.dumps(at(json.loads((ROOT / "pretrained" / source / "config.json").read_text()), path, value)))
    damaged(load_model, "model", "model/")


def test_weights_that_are_no_numbers_though_the_hash_is_right() -> None:
    model("driving", "{}")
    weights = Path("model/model.safetensors")
    tensors = safetensors.torch.load_file(weights)
    with safetensors.safe_open(weights, framework="pt") as file:
        header = file.metadata()
    tensors["denoiser.net.head.bias"][3] = float("nan")
    weights.unlink()
    safetensors.torch.save_file(tensors, weights, header)
    Path("model/config.json").write_text(json.dumps(DRIVING | {"hash": file_hash(weights)}))
    damaged(load_model, "model", "model.safetensors: key 'denoiser.net.head.bias': expected finite")


# Learned concepts

SHIPPED = json.loads((ROOT / "pretrained/agent/config.json").read_text())
ORIGIN = {"kind": "concept", "format": concept.VERSION, "name": PUSH, "domain": "agent", "encoder": SHIPPED["encoder"]}
ORIGIN |= {"pretrained": SHIPPED["hash"], "demonstrations": ZERO, "count": 5, "weights": "fixed", "loss": 0.1}
PLAIN = {"embeddings": torch.zeros(2, 1, 384), "weights": torch.ones(2)}
MODES = ORIGIN | {"mixed": False}


def adapted(outputs: int, rank: int) -> dict[str, torch.Tensor]:
    layer = "adapter/net.time.0.weight"
    return PLAIN | {f"{layer}/up": torch.zeros(outputs, 2), f"{layer}/down": torch.zeros(rank, 32)}


@pytest.fixture(scope="module")
def agent() -> ConceptModel:
    return load_model("agent")


@pytest.mark.parametrize(
    ("header", "tensors", "expected"),
    [
        *((header, PLAIN, "file of other software") for header in ([], {})),
        (ORIGIN | {"kind": ["concept"]}, PLAIN, "expected a concept file"),
        (ORIGIN | {"format": "5"}, PLAIN, "key 'format': expected 5, found '5'"),
        (ORIGIN | {"format": [1]}, PLAIN, "key 'format'"),
        (ORIGIN | {"name": nested(100)}, PLAIN, "deep"),
        (ORIGIN | {"name": {"a": 1}}, PLAIN, "key 'name': expected a text"),
        (ORIGIN | {"name": "\ud800"}, PLAIN, "Unicode"),
        *((ORIGIN | {"count": count}, PLAIN, "key 'count'") for count in ("5", -1)),
        (ORIGIN | {"loss": "low"}, PLAIN, "key 'loss'"),
        (ORIGIN | {"loss": float("nan")}, PLAIN, "finite"),
        (ORIGIN | {"components": 3}, PLAIN, "key 'components': expected 2, found 3"),
        *((ORIGIN | {"pretrained": value}, PLAIN, "key 'pretrained'") for value in (3, ZERO)),
        (ORIGIN | {"domain": "driving"}, PLAIN, "key 'domain': expected 'agent'"),
        (ORIGIN, PLAIN | {"weights": torch.ones(1)}, "key 'weights': expected float32 of shape (2,), found float32 of shape (1,)"),
        *((ORIGIN, PLAIN | {"weights": ones}, "key 'weights'") for ones in (torch.ones(2, 2), torch.ones(2, dtype=torch.int64))),
        (ORIGIN, PLAIN | {"embeddings": torch.zeros(2, 1, 384, dtype=torch.float64)}, "key 'embeddings': expected float32"),
        (ORIGIN, PLAIN | {"embeddings": torch.zeros(2, 1, 383)}, "key 'embeddings': expected 384 numbers each, found 383"),
        (ORIGIN, PLAIN | {"embeddings": torch.zeros(768)}, "key 'embeddings'"),
        (ORIGIN, {"embeddings": torch.zeros(0, 1, 384), "weights": torch.zeros(0)}, "key 'embeddings'"),
        (ORIGIN, PLAIN | {"embeddings": torch.full((2, 1, 384), float("nan"))}, "'embeddings'"),
        (ORIGIN, PLAIN | {"weights": torch.tensor([1.0, float("inf")])}, "'weights'"),
        (ORIGIN, PLAIN | {"more": torch.zeros(1)}, "found more too"),
        (ORIGIN, {"weights": torch.ones(2)}, "found none of embeddings"),
        (MODES, PLAIN, "found none of mode_embeddings, mode_weights"),
        (MODES, PLAIN | {"mode_embeddings": torch.zeros(3, 2, 1, 384), "mode_weights": torch.zeros(2, 2)}, "key 'mode_weights'"),
        (MODES, PLAIN | {"mode_embeddings": torch.zeros(3, 1, 1, 384), "mode_weights": torch.zeros(3, 2)}, "key 'mode_embeddings'"),
        (
            MODES | {"mixed": "no"},
            PLAIN | {"mode_embeddings": torch.zeros(3, 2, 1, 384), "mode_weights": torch.zeros(3, 2)},
            "mixed",
        ),
        (ORIGIN, PLAIN | {"embeddings": torch.zeros(2, 384)}, "key 'embeddings': expected shape (K, knots, n), found (2, 384)"),
        (ORIGIN, PLAIN | {"embeddings": torch.zeros(2, 0, 384)}, "key 'embeddings'"),
        (ORIGIN, PLAIN | {"adapter/net.time.0.weight/up": torch.zeros(128, 2)}, "key 'adapter/net.time.0.weight'"),
        (ORIGIN, PLAIN | {"adapter/x/up": torch.zeros(3, 2), "adapter/x/down": torch.zeros(2, 3)}, "key 'adapter/x'"),
        (ORIGIN, adapted(128, 3), "key 'adapter/net.time.0.weight': expected shapes (outputs, rank) and (rank, inputs)"),
        (ORIGIN, adapted(127, 2), "key 'adapter/net.time.0.weight': expected the sizes (128, 32), found (127, 32)"),
    ],
    ids=lambda value: str(value)[:60] if isinstance(value, str) else "",
)
def test_a_learned_concept(agent: ConceptModel, header: object, tensors: dict[str, torch.Tensor], expected: str) -> None:
    safetensors.torch.save_file(tensors, "c.safetensors", {"ftl_lightning": json.dumps(header)})
    damaged(lambda path: check_concept(agent, Concept.load(path), path), "c.safetensors", "c.safetensors: ", expected)


# Demonstrations

FORM = {"kind": "demonstrations", "format": files.VERSION, "domain": "agent", "concepts": ["", ""], "per_step": []}
STATES = {"states": torch.zeros(2, 3, 13), "lengths": torch.full((2,), 3), "observed/world": torch.zeros(2, 52)}


@pytest.mark.parametrize(
    ("header", "tensors", "expected"),
    [
        (FORM | {"concepts": [1, 2]}, STATES, "key 'concepts[0]': expected a text, found 1"),
        (FORM | {"concepts": "text"}, STATES, "key 'concepts'"),
        (FORM | {"concepts": ["", "", ""]}, STATES, "key 'concepts': expected 2 entries, found 3"),
        *((FORM | {"per_step": value}, STATES, "key 'per_step'") for value in ("world", {"world": 1}, ["x" * 999])),
        (FORM | {"per_step": ["world"]}, STATES, "key 'observed/world'"),
        (FORM | {"provenance": nested(100)}, STATES, "deep"),
        (FORM | {"provenance": [1]}, STATES, "key 'provenance': expected a mapping"),
        (FORM | {"domain": 3}, STATES, "key 'domain': expected a text"),
        (FORM | {"domain": "driving"}, STATES, "expected behaviour of agent, the model's domain, found that of driving"),
        (FORM | {"format": 3}, STATES, "key 'format': expected 4, found 3"),
        (FORM | {"compressed": [3]}, STATES, "key 'compressed'"),
        (FORM | {"compressed": {"observed/x": [2, 10**12]}}, STATES, "observed/x"),
        (FORM, STATES | {"states": torch.zeros(2, 3, 13, dtype=torch.float16)}, "key 'states': expected float32"),
        *((FORM, STATES | {"states": states}, "key 'states'") for states in (torch.zeros(2, 3), torch.zeros(2, 3, 5))),
        (FORM, STATES | {"states": torch.full((2, 3, 13), float("nan"))}, "key 'states': expected finite numbers"),
        (FORM, STATES | {"lengths": torch.tensor([3.0, float("nan")])}, "key 'lengths': expected whole numbers"),
        *((FORM, STATES | {"lengths": torch.tensor(lengths)}, "key 'lengths'") for lengths in ([3, 4], [3] * 5000)),
        (FORM, STATES | {"observed/world": torch.zeros(2, 51)}, "key 'observed/world'"),
        (FORM, STATES | {"scenes": torch.zeros(2, 3, dtype=torch.float64)}, "key 'scenes': expected float32"),
        (FORM, {"lengths": torch.full((2,), 3)}, "key 'states'"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_demonstrations(header: object, tensors: dict[str, torch.Tensor], expected: str) -> None:
    safetensors.torch.save_file(tensors, "d.safetensors", {"ftl_lightning": json.dumps(header)})
    damaged(of_agent, "d.safetensors", "d.safetensors: ", expected)


def of_agent(path: str) -> object:
    return read_demonstrations(path, load_domain("agent"))


def archive(changed: Callable[[bytes], bytes] = bytes, **arrays: Any) -> bytes:
    """An ``.npz``, the first array's bytes changed."""
    file, found = io.BytesIO(), io.BytesIO()
    np.savez(file, **arrays)
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(found, "w", zipfile.ZIP_DEFLATED) as new:
        for number, name in enumerate(old.namelist()):
            new.writestr(name, old.read(name) if number else changed(old.read(name)))
    return found.getvalue()


NUMBERS = np.zeros((2, 3, 13), np.float32)
LARGE = archive(lambda data: data.replace(b"(2, 3, 13)", b"(2, 3, 13000000000)"), states=NUMBERS)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        *((content, "damaged") for content in (b"", b"PK\x03\x04" * 9, LARGE)),
        *((archive(change, states=NUMBERS), "damaged") for change in (lambda data: data[:60], lambda data: b"text")),
        (archive(states=NUMBERS).replace(b"PK\x01\x02\x14\x03\x14\x00\x00", b"PK\x01\x02\x14\x03\x14\x00\x01"), "damaged"),
        (archive(states=np.array([{}], dtype=object)), "found Python objects; pad recordings"),
        *((archive(states=NUMBERS.astype(kind)), "key 'states': expected an array of numbers") for kind in (complex, str)),
        (archive(states=np.full((2, 3, 13), 1e300)), "key 'states': expected finite numbers"),
        (archive(states=NUMBERS, lengths=np.array([2.7, np.nan])), "key 'lengths': expected whole numbers"),
        (archive(states=NUMBERS, lengths=np.array(3)), "key 'lengths'"),
        (archive(states=NUMBERS, concepts=np.array([1, 2])), "key 'concepts': expected an array of texts"),
        (archive(states=NUMBERS, domain=np.array([], dtype=str)), "key 'domain'"),
        (archive(states=np.zeros((), np.float32), concepts=np.array("a")), "key 'states'"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_demonstrations_in_npz(content: bytes, expected: str) -> None:
    Path("d.npz").write_bytes(content)
    damaged(of_agent, "d.npz", "d.npz: ", expected)


# Results

CELLS = ["agent", "paper", "go", "BC", "", "", "method", "1", "1.2", "5", "0", "10", "accuracy", "0.5", ZERO, ZERO, "1"]
ROW = dict(zip(COLUMNS, CELLS, strict=True))


@pytest.mark.parametrize("column", ["K", "demonstrations", "seed", "n", "value"])
def test_a_cell_of_the_results(column: str) -> None:
    for cell in ("abc", "", "nan", "inf", "1e999", "True", "9" * 400):
        rows = [ROW, ROW | {"task": "come", column: cell}]
        Path("r.csv").write_text("\n".join(",".join(row) for row in (COLUMNS, *(row.values() for row in rows))))
        damaged(read_rows, "r.csv", f"r.csv: row 3, column {column!r}: expected ")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (",".join(ROW.values()), "expected the columns"),
        ("\n".join((",".join(COLUMNS), ",".join(ROW.values()) + ",more")), "more in some"),
        ("\n".join((",".join(COLUMNS), ",".join(ROW.values())[:-9])), "r.csv: row 2"),
        *(
            ("\n".join((",".join(COLUMNS), ",".join((ROW | {column: cell}).values()))), f"row 2, column '{column}'")
            for column, cell in (("role", "judge"), ("K", "-1"), ("n", "0.5"))
        ),
        ("", "found something else"),
        ('"' * 99, "r.csv: "),
        ("x," * 5000, "expected the columns"),
    ],
    ids=lambda value: value[-30:],
)
def test_results(text: str, expected: str) -> None:
    Path("r.csv").write_text(text)
    damaged(read_rows, "r.csv", "r.csv: ", expected)


# Configurations

BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 10))
YAML: list[tuple[bytes, str]] = [
    (BOMB.encode(), "expansion"),
    (b"a: &a [*a]", "recursive"),
    *((text, "expected a configuration file") for text in (b"a: \xff\xfe", b"a: !unknown 3", b"a: [1", b"a: ${unclosed")),
    (b"a: " + b"[" * 5000 + b"]" * 5000, "expected a configuration file"),
    (b"a: " + b"{a: " * 400 + b"1" + b"}" * 400, "deeper than 40"),
    (b"a: !!python/object/apply:os.system [ls]", "expected a configuration file"),
    (b"- 1\n- 2", "expected a mapping"),
    *((text, "key 'defaults'") for text in (b"defaults: [3]", b"defaults: c.yaml")),
    (b"defaults: [c.yaml]", "builds on"),
    (b"a: " + b"x" * 2_000_000, "at most 200000 bytes"),
]


@pytest.mark.parametrize(("content", "expected"), YAML, ids=lambda value: str(value)[:30])
def test_a_configuration_file(content: bytes, expected: str) -> None:
    Path("c.yaml").write_bytes(content)
    damaged(load, "c.yaml", "c.yaml", expected)


@pytest.mark.parametrize("verb", ["fit", "invert", "validate", "test", "report", "explain", "study", "ablate"])
def test_a_configuration_file_of_every_verb(verb: str, capsys: Told) -> None:
    Path("c.yaml").write_text(BOMB)
    refused(capsys, [verb, "--config=c.yaml"], "c.yaml", "expansion")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[{verb: fit, config: ''}]", "expected a configuration file"),
        ("[{verb: fit, config: nothing.yaml}]", "nothing.yaml"),
        ("[{verb: fly, config: a.yaml}]", "fly"),
        ("3", "stages"),
        ("[{verb: fit, config: '${unknown}'}]", "unknown"),
    ],
)
def test_the_stages_of_an_ablation(text: str, expected: str, capsys: Told) -> None:
    Path("c.yaml").write_text(f"stages: {text}\nresults: r.csv")
    refused(capsys, ["ablate", "--config=c.yaml"], expected)


def test_a_configuration_that_names_an_unknown_key(capsys: Told) -> None:
    Path("c.yaml").write_text("model: {init_args: {seed: '${unknown}'}}")
    refused(capsys, ["fit", "--config", str(CONF / "object_rearrangement.yaml"), "--config=c.yaml"], "unknown")


# Verbs


def test_verbs_refuse_what_is_damaged(capsys: Told) -> None:
    model("driving", json.dumps(at(DRIVING, "horizon", "8")))
    safetensors.torch.save_file(PLAIN, "c.safetensors", {"ftl_lightning": json.dumps(ORIGIN | {"pretrained": ZERO})})
    Path("d.npz").write_bytes(LARGE)
    Path("r.csv").write_text("x," * 5000)
    Path("c.yaml").write_text(BOMB)
    sample = ["sample", "--pretrained=agent", f"--compose={PUSH}"]
    refused(capsys, ["sample", "--pretrained=model", "--compose=merge"], "model/config.json: ", "key 'horizon'")
    refused(capsys, ["explain", "--pretrained=agent", "--concept=c.safetensors"], "c.safetensors: ", "key 'pretrained'")
    refused(capsys, [*sample, "--initial=d.npz"], "d.npz: ", "damaged")
    refused(capsys, [*sample, "--settings=c.yaml"], "c.yaml: ", "expansion")
    refused(capsys, ["report", "--results=r.csv", "--out=out"], "r.csv: ", "expected the columns")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([*MERGE, "--count=5000", "--figure=a.png"], "count: expected a number"),
        ([*MERGE, "--steps=1000000000000"], "steps: expected a number"),
        ([*MERGE, "--seed=-1"], "seed: expected 0 or more"),
        (["generate", "driving", "--count=1000000000000"], "count: expected a number"),
        (["generate", "driving", "--workers=1000000"], "workers: expected a number"),
        (["explain", "--concept=c.safetensors", "--nearest=1000000000000"], "expected"),
        (["study", "mocap", "--scenarios=1000000000000"], "scenarios: expected a number"),
        (["encode", "driving", "--encoder=folder", "--out=t.safetensors"], "encoder: "),
        (["prepare", "driving", "--root=folder"], "domain: "),
        (["study-report", "folder"], "expected"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_numbers_and_folders(arguments: list[str], expected: str, capsys: Told) -> None:
    Path("folder").mkdir()
    Path("folder/config.json").write_text('{"model_type": "bert", "hidden_size": 8}')
    refused(capsys, arguments, expected)
