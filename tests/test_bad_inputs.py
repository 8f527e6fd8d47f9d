"""Files and numbers that are damaged, wrong or hostile, through the command line: one line, exit code 2, and nothing is written."""

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

from ftl_lightning.evaluation.results import COLUMNS
from ftl_lightning.tensor_file import file_hash

from .conftest import CONF, ROOT, refused

Told = pytest.CaptureFixture[str]
PUSH = "go to red object"
ZERO = "0" * 16


def at(tree: dict[str, Any], path: str, value: object) -> dict[str, Any]:
    """A copy of a mapping with one value in it changed; ``...`` removes it."""
    tree = json.loads(json.dumps(tree))
    holder = tree
    *above, last = path.split(".")
    for key in above:
        holder = holder[key]
    if value is ...:
        del holder[last]
    else:
        holder[last] = value
    return tree


def nested(depth: int) -> Any:
    found: Any = 0
    for _ in range(depth):
        found = [found]
    return found


# A pretrained model's configuration


def model(source: str, text: str) -> None:
    """A folder ``model`` with a shipped model's weights and this configuration."""
    Path("model").mkdir()
    Path("model/model.safetensors").symlink_to(ROOT / "pretrained" / source / "model.safetensors")
    Path("model/config.json").write_text(text, encoding="utf-8", errors="surrogatepass")


DRIVING = json.loads((ROOT / "pretrained/driving/config.json").read_text())
CONFIGS: list[tuple[str, object, str]] = [
    ("format", 3, "format"),
    ("format", True, "format"),
    ("format", ..., "format"),
    ("hash", ..., "key 'hash': expected a text, found None"),
    ("hash", 7, "key 'hash': expected a text, found 7"),
    ("hash", ZERO, "expected the hash 0000000000000000"),
    ("kind", "gan", "key 'kind': expected one of diffusion"),
    ("kind", ["diffusion"], "key 'kind': expected a text"),
    ("kind", "bc", "config.json: key 'denoiser'"),
    ("domain", "nowhere", "domain: expected one of"),
    ("domain", {}, "key 'domain': expected a text"),
    ("domain", "json:loads", "asks for code, 'json:loads', that no installed package offers: it was not imported"),
    ("domain", "agent", "agent"),
    ("horizon", "8", "key 'horizon': expected a whole number from 0 to 1000000, found '8'"),
    ("horizon", 8.0, "key 'horizon'"),
    ("horizon", True, "key 'horizon'"),
    ("horizon", 0, "horizon: expected a number from 1"),
    ("horizon", -8, "key 'horizon'"),
    ("horizon", 10**9, "key 'horizon'"),
    ("horizon", 10**6, "horizon: expected a number from 1 to 10000"),
    ("horizon", 8000, "larger network"),
    ("horizon", ..., "key 'horizon': expected a value, found none"),
    ("state_dim", 8, "key 'state_dim': expected 7 (domain driving), found 8"),
    ("concept_dim", 10**6, "larger network"),
    ("concept_dim", 383, "expected float32 (383,), found float32 (384,)"),
    ("concept_dim", None, "key 'concept_dim'"),
    ("training_concepts", "merge", "key 'training_concepts': expected a list"),
    ("training_concepts", ["merge", 3], "key 'training_concepts[1]': expected a text, found 3"),
    ("training_concepts", [], "training_embeddings"),
    ("training_concepts", ["\ud800"] * 4, "Unicode"),
    ("encoder", ["x"], "key 'encoder'"),
    ("view", "sideways", "model.view: expected one of"),
    ("view", 3, "key 'view'"),
    ("perturb", "yes", "key 'perturb': expected true or false, found 'yes'"),
    ("metrics", {"accuracy": "high"}, "key 'metrics.accuracy': expected a finite number"),
    ("metrics", {"accuracy": float("nan")}, "expected finite numbers, found nan"),
    ("observed", [], "key 'observed': expected a mapping"),
    ("observed.traffic", 35, "key 'observed.traffic': expected a mapping"),
    ("observed.traffic.shape", 35, "key 'observed.traffic.shape': expected a list"),
    ("observed.traffic.shape", [10**6, 10**6], "observed"),
    ("observed.traffic.kind", "sound", "key 'observed.traffic.kind': expected one of 'vector', 'image'"),
    ("observed.traffic.entities", [[0, 1], [2]], "entities"),
    ("observed.traffic.entities", [[35]], "entities: expected columns from 0 to 34"),
    ("observed.traffic.state", [99], "state: expected columns"),
    ("observed.traffic.state", [0, 1], "state: expected 7 columns, found 2"),
    ("observed.traffic.more", 1, "key 'observed.traffic.more': expected one of"),
    ("image_dim", 10, "image_dim"),
    ("unknown", 1, "key 'unknown': expected one of"),
    ("training", nested(60), "deep"),
    ("denoiser", "Transformer", "denoiser: expected one of"),
    ("denoiser", 3, "key 'denoiser'"),
    ("denoiser_args", [1], "key 'denoiser_args': expected a mapping"),
    ("denoiser_args.depth", 10_000_000, "key 'denoiser_args.depth'"),
    ("denoiser_args.depth", 1_000_000, "larger network"),
    ("denoiser_args.depth", "4", "key 'denoiser_args.depth'"),
    ("denoiser_args.depth", 5, "does not fit config.json"),
    ("denoiser_args.hidden_dim", 10**6, "larger network"),
    ("denoiser_args.hidden_dim", nested(3), "key 'denoiser_args.hidden_dim'"),
    ("denoiser_args.width", 3, "key 'denoiser_args.width': expected one of"),
    ("denoiser_args.initial_encoder", "x" * 500, "denoiser_args.initial_encoder"),
    ("diffusion_steps", 0, "config.json"),
    ("diffusion_steps", 99, "alpha_bar"),
    ("prediction", "future", "prediction: expected one of"),
]


@pytest.mark.parametrize(("path", "value", "expected"), CONFIGS, ids=lambda value: str(value)[:40])
def test_a_configuration_of_a_model(path: str, value: object, expected: str, capsys: Told) -> None:
    model("driving", json.dumps(at(DRIVING, path, value)))
    refused(capsys, ["sample", "--pretrained=model", "--compose=merge"], "model/", expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "expected JSON"),
        ("[]", "format"),
        ("null", "format"),
        ('{"format": 2, "format": 2}', "key 'format': expected it once"),
        ("[" * 100_000, "too deep"),
        ('{"format": 2, "hash": 1e999}', "finite"),
        ('{"format": 2, "horizon": ' + "9" * 5000 + "}", "expected JSON"),
        (json.dumps(DRIVING)[:-1], "expected JSON"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_a_configuration_that_is_no_json(text: str, expected: str, capsys: Told) -> None:
    model("driving", text)
    refused(capsys, ["sample", "--pretrained=model", "--compose=merge"], "model/config.json", expected)


@pytest.mark.parametrize(
    ("kind", "path", "value"),
    [
        ("in_context", "layers", 100_000),
        ("in_context", "heads", 0),
        ("in_context", "stride", 0),
        ("bc", "members", 10**6),
        ("bc", "members", 0),
        ("bc", "hidden_dim", 10**6),
        ("cvae", "hidden_dim", [512]),
        ("cvae", "hidden_dim", 511),
    ],
)
def test_a_configuration_of_a_baseline(kind: str, path: str, value: object, capsys: Told) -> None:
    source = f"baseline/{kind}/driving"
    model(source, json.dumps(at(json.loads((ROOT / "pretrained" / source / "config.json").read_text()), path, value)))
    refused(capsys, ["sample", "--pretrained=model", "--compose=merge"], "model/")


def test_weights_that_are_no_numbers_though_the_hash_is_right(capsys: Told) -> None:
    model("driving", "{}")
    weights = Path("model/model.safetensors")
    tensors = safetensors.torch.load_file(weights)
    with safetensors.safe_open(weights, framework="pt") as file:
        header = file.metadata()
    tensors["denoiser.net.head.bias"][3] = float("nan")
    weights.unlink()
    safetensors.torch.save_file(tensors, weights, header)
    Path("model/config.json").write_text(json.dumps(DRIVING | {"hash": file_hash(weights)}))
    refused(
        capsys,
        ["sample", "--pretrained=model", "--compose=merge"],
        "model.safetensors: key 'denoiser.net.head.bias': expected finite",
    )


# Learned concepts

SHIPPED = json.loads((ROOT / "pretrained/agent/config.json").read_text())
ORIGIN = {
    "kind": "concept",
    "format": 1,
    "name": PUSH,
    "domain": "agent",
    "encoder": SHIPPED["encoder"],
    "pretrained": SHIPPED["hash"],
    "demonstrations": ZERO,
    "count": 5,
    "weights": "fixed",
    "loss": 0.1,
}
PLAIN = {"embeddings": torch.zeros(2, 384), "weights": torch.ones(2)}
KNOTS = ORIGIN | {"format": 3, "axes": "mode component knot n"}
THREE = {"embeddings": torch.zeros(2, 1, 384), "weights": torch.ones(2)}
MODES = ORIGIN | {"format": 2, "axes": "mode component n", "mixed": False}
NAN = torch.full((2, 384), float("nan"))


@pytest.mark.parametrize(
    ("header", "tensors", "expected"),
    [
        ([], PLAIN, "file of other software"),
        ({}, PLAIN, "file of other software"),
        (ORIGIN | {"kind": ["concept"]}, PLAIN, "expected a concept file"),
        (ORIGIN | {"format": "1"}, PLAIN, "key 'format': expected 1 or 2 or 3 or 4, found '1'"),
        (ORIGIN | {"format": [1]}, PLAIN, "key 'format'"),
        (ORIGIN | {"name": nested(100)}, PLAIN, "deep"),
        (ORIGIN | {"name": {"a": 1}}, PLAIN, "key 'name': expected a text"),
        (ORIGIN | {"name": "\ud800"}, PLAIN, "Unicode"),
        (ORIGIN | {"count": "5"}, PLAIN, "key 'count'"),
        (ORIGIN | {"count": -1}, PLAIN, "key 'count'"),
        (ORIGIN | {"loss": "low"}, PLAIN, "key 'loss'"),
        (ORIGIN | {"loss": float("nan")}, PLAIN, "finite"),
        (ORIGIN | {"components": 3}, PLAIN, "key 'components': expected 2, found 3"),
        (ORIGIN | {"pretrained": 3}, PLAIN, "key 'pretrained'"),
        (ORIGIN | {"pretrained": ZERO}, PLAIN, "key 'pretrained'"),
        (ORIGIN | {"domain": "driving"}, PLAIN, "key 'domain': expected 'agent'"),
        (ORIGIN, PLAIN | {"weights": torch.ones(1)}, "key 'weights': expected float32 of shape (2,), found float32 of shape (1,)"),
        (ORIGIN, PLAIN | {"weights": torch.ones(2, 2)}, "key 'weights'"),
        (ORIGIN, PLAIN | {"weights": torch.ones(2, dtype=torch.int64)}, "key 'weights'"),
        (ORIGIN, PLAIN | {"embeddings": torch.zeros(2, 384, dtype=torch.float64)}, "key 'embeddings': expected float32"),
        (ORIGIN, PLAIN | {"embeddings": torch.zeros(2, 383)}, "key 'embeddings': expected 384 numbers each, found 383"),
        (ORIGIN, PLAIN | {"embeddings": torch.zeros(768)}, "key 'embeddings'"),
        (ORIGIN, {"embeddings": torch.zeros(0, 384), "weights": torch.zeros(0)}, "key 'embeddings'"),
        (ORIGIN, PLAIN | {"embeddings": NAN}, "'embeddings'"),
        (ORIGIN, PLAIN | {"weights": torch.tensor([1.0, float("inf")])}, "'weights'"),
        (ORIGIN, PLAIN | {"more": torch.zeros(1)}, "found more too"),
        (ORIGIN, {"weights": torch.ones(2)}, "found none of embeddings"),
        (MODES, PLAIN, "found none of mode_embeddings, mode_weights"),
        (MODES, PLAIN | {"mode_embeddings": torch.zeros(3, 2, 384), "mode_weights": torch.zeros(2, 2)}, "key 'mode_weights'"),
        (MODES, PLAIN | {"mode_embeddings": torch.zeros(3, 1, 384), "mode_weights": torch.zeros(3, 2)}, "key 'mode_embeddings'"),
        (MODES | {"mixed": "no"}, PLAIN | {"mode_embeddings": torch.zeros(3, 2, 384), "mode_weights": torch.zeros(3, 2)}, "mixed"),
        (KNOTS | {"axes": 3}, THREE, "key 'axes'"),
        (KNOTS, PLAIN, "key 'embeddings'"),
        (KNOTS, THREE | {"embeddings": torch.zeros(2, 0, 384)}, "key 'embeddings'"),
        (KNOTS, THREE | {"adapter/net.time.0.weight/up": torch.zeros(128, 2)}, "key 'adapter/net.time.0.weight'"),
        (KNOTS, THREE | {"adapter/x/up": torch.zeros(3, 2), "adapter/x/down": torch.zeros(2, 3)}, "key 'adapter/x'"),
        (
            KNOTS,
            THREE | {"adapter/net.time.0.weight/up": torch.zeros(128, 2), "adapter/net.time.0.weight/down": torch.zeros(3, 32)},
            "key 'adapter/net.time.0.weight': expected shapes (outputs, rank) and (rank, inputs)",
        ),
        (
            KNOTS,
            THREE | {"adapter/net.time.0.weight/up": torch.zeros(127, 2), "adapter/net.time.0.weight/down": torch.zeros(2, 32)},
            "key 'adapter/net.time.0.weight': expected the sizes (128, 32), found (127, 32)",
        ),
    ],
    ids=lambda value: str(value)[:60] if isinstance(value, str) else "",
)
def test_a_learned_concept(header: object, tensors: dict[str, torch.Tensor], expected: str, capsys: Told) -> None:
    safetensors.torch.save_file(tensors, "c.safetensors", {"ftl_lightning": json.dumps(header)})
    refused(capsys, ["explain", "--pretrained=agent", "--concept=c.safetensors"], "c.safetensors: ", expected)


# Demonstrations

FORM = {"kind": "demonstrations", "format": 2, "domain": "agent", "concepts": ["", ""], "per_step": []}
COLUMN = 13
STATES = {"states": torch.zeros(2, 3, COLUMN), "lengths": torch.full((2,), 3), "observed/world": torch.zeros(2, 52)}


@pytest.mark.parametrize(
    ("header", "tensors", "expected"),
    [
        (FORM | {"concepts": [1, 2]}, STATES, "key 'concepts': expected a list of texts"),
        (FORM | {"concepts": "text"}, STATES, "key 'concepts'"),
        (FORM | {"concepts": ["", "", ""]}, STATES, "key 'concepts': expected 2 entries, found 3"),
        (FORM | {"per_step": "world"}, STATES, "key 'per_step'"),
        (FORM | {"per_step": {"world": 1}}, STATES, "key 'per_step'"),
        (FORM | {"per_step": ["x" * 999]}, STATES, "key 'per_step'"),
        (FORM | {"per_step": ["world"]}, STATES, "key 'observed/world'"),
        (FORM | {"provenance": nested(100)}, STATES, "deep"),
        (FORM | {"provenance": [1]}, STATES, "key 'provenance': expected a mapping"),
        (FORM | {"domain": 3}, STATES, "key 'domain': expected a text"),
        (FORM | {"domain": "driving"}, STATES, "key 'domain': expected 'agent', found 'driving'"),
        (FORM | {"format": 3}, STATES, "key 'compressed'"),
        (FORM | {"format": 3, "compressed": {"observed/x": [2, 10**12]}}, STATES, "observed/x"),
        (FORM, STATES | {"states": torch.zeros(2, 3, COLUMN, dtype=torch.float64)}, "key 'states': expected float32"),
        (FORM, STATES | {"states": torch.zeros(2, 3)}, "key 'states'"),
        (FORM, STATES | {"states": torch.zeros(2, 3, 5)}, "key 'states'"),
        (FORM, STATES | {"states": torch.full((2, 3, COLUMN), float("nan"))}, "key 'states': expected finite numbers"),
        (FORM, STATES | {"lengths": torch.tensor([3.0, float("nan")])}, "key 'lengths': expected whole numbers"),
        (FORM, STATES | {"lengths": torch.tensor([3, 4])}, "key 'lengths'"),
        (FORM, STATES | {"lengths": torch.full((5000,), 3)}, "key 'lengths'"),
        (FORM, STATES | {"observed/world": torch.zeros(2, 51)}, "key 'observed/world'"),
        (FORM, STATES | {"scenes": torch.zeros(2, 3, dtype=torch.float64)}, "key 'scenes': expected float32"),
        (FORM, {"lengths": torch.full((2,), 3)}, "key 'states'"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_demonstrations(header: object, tensors: dict[str, torch.Tensor], expected: str, capsys: Told) -> None:
    safetensors.torch.save_file(tensors, "d.safetensors", {"ftl_lightning": json.dumps(header)})
    refused(capsys, ["sample", "--pretrained=agent", f"--compose={PUSH}", "--initial=d.safetensors"], "d.safetensors: ", expected)


def archive(changed: Callable[[bytes], bytes] = bytes, **arrays: Any) -> bytes:
    """An ``.npz``, the first array's bytes changed."""
    file, found = io.BytesIO(), io.BytesIO()
    np.savez(file, **arrays)
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(found, "w", zipfile.ZIP_DEFLATED) as new:
        for number, name in enumerate(old.namelist()):
            new.writestr(name, old.read(name) if number else changed(old.read(name)))
    return found.getvalue()


NUMBERS = np.zeros((2, 3, COLUMN), np.float32)
LARGE = archive(lambda data: data.replace(b"(2, 3, 13)", b"(2, 3, 13000000000)"), states=NUMBERS)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "damaged"),
        (b"PK\x03\x04" * 9, "damaged"),
        (LARGE, "damaged"),
        (archive(lambda data: data[:60], states=NUMBERS), "damaged"),
        (archive(lambda data: b"text", states=NUMBERS), "damaged"),
        (archive(states=NUMBERS).replace(b"PK\x01\x02\x14\x03\x14\x00\x00", b"PK\x01\x02\x14\x03\x14\x00\x01"), "damaged"),
        (archive(states=np.array([{}], dtype=object)), "objects"),
        (archive(states=NUMBERS.astype(complex)), "key 'states': expected an array of numbers"),
        (archive(states=NUMBERS.astype(str)), "key 'states': expected an array of numbers"),
        (archive(states=np.full((2, 3, COLUMN), 1e300)), "key 'states': expected finite numbers"),
        (archive(states=NUMBERS, lengths=np.array([2.7, np.nan])), "key 'lengths': expected whole numbers"),
        (archive(states=NUMBERS, lengths=np.array(3)), "key 'lengths'"),
        (archive(states=NUMBERS, concepts=np.array([1, 2])), "key 'concepts': expected an array of texts"),
        (archive(states=NUMBERS, concepts=np.array([["a", "b"]])), "key 'concepts'"),
        (archive(states=NUMBERS, domain=np.array([], dtype=str)), "key 'domain'"),
        (archive(states=np.zeros((), np.float32), concepts=np.array("a")), "key 'states'"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_demonstrations_in_npz(content: bytes, expected: str, capsys: Told) -> None:
    Path("d.npz").write_bytes(content)
    refused(capsys, ["sample", "--pretrained=agent", f"--compose={PUSH}", "--initial=d.npz"], "d.npz: ", expected)


def test_a_small_archive_of_a_large_array(capsys: Told) -> None:
    with zipfile.ZipFile("d.npz", "w", zipfile.ZIP_DEFLATED) as file, file.open("states.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array_header_1_0(member, {"descr": "<f4", "fortran_order": False, "shape": (1, 2**18, 600)})
        for _ in range(600):
            member.write(bytes(2**20))
    refused(capsys, ["sample", "--pretrained=agent", f"--compose={PUSH}", "--initial=d.npz"], "d.npz: ", "without compression")


# Results

CELLS = ["agent", "paper", "go", "BC", "", "", "method", "1", "1.2", "5", "0", "10", "accuracy", "0.5", ZERO, ZERO, "1"]
ROW = dict(zip(COLUMNS, CELLS, strict=True))


@pytest.mark.parametrize("column", ["K", "demonstrations", "seed", "n", "value"])
@pytest.mark.parametrize("cell", ["abc", "", "nan", "inf", "1e999", "True", "9" * 400])
def test_a_cell_of_the_results(column: str, cell: str, capsys: Told) -> None:
    rows = [ROW, ROW | {"task": "come", column: cell}]
    Path("r.csv").write_text("\n".join(",".join(row) for row in (COLUMNS, *(row.values() for row in rows))))
    refused(capsys, ["report", "--results=r.csv", "--out=out"], f"r.csv: row 3, column {column!r}: expected ")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (",".join(ROW.values()), "expected the columns"),
        ("\n".join((",".join(COLUMNS), ",".join(ROW.values()) + ",more")), "more in some"),
        ("\n".join((",".join(COLUMNS), ",".join(ROW.values())[:-9])), "r.csv: row 2"),
        ("\n".join((",".join(COLUMNS), ",".join((ROW | {"role": "judge"}).values()))), "row 2, column 'role'"),
        ("\n".join((",".join(COLUMNS), ",".join((ROW | {"K": "-1"}).values()))), "row 2, column 'K'"),
        ("\n".join((",".join(COLUMNS), ",".join((ROW | {"n": "0.5"}).values()))), "row 2, column 'n'"),
        ("", "found something else"),
        ('"' * 99, "r.csv: "),
        ("x," * 5000, "expected the columns"),
    ],
    ids=lambda value: value[-30:],
)
def test_results(text: str, expected: str, capsys: Told) -> None:
    Path("r.csv").write_text(text)
    refused(capsys, ["report", "--results=r.csv", "--out=out"], "r.csv: ", expected)


# Configurations

BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 10))
YAML: list[tuple[bytes, str]] = [
    (BOMB.encode(), "expansion"),
    (b"a: &a [*a]", "recursive"),
    (b"a: \xff\xfe", "expected a configuration file"),
    (b"a: " + b"[" * 5000 + b"]" * 5000, "expected a configuration file"),
    (b"a: " + b"{a: " * 400 + b"1" + b"}" * 400, "recursion"),
    (b"a: !!python/object/apply:os.system [ls]", "expected a configuration file"),
    (b"a: !unknown 3", "expected a configuration file"),
    (b"- 1\n- 2", "expected a mapping"),
    (b"a: [1", "expected a configuration file"),
    (b"defaults: [3]", "key 'defaults'"),
    (b"defaults: c.yaml", "key 'defaults'"),
    (b"defaults: [c.yaml]", "builds on"),
    (b"a: ${unclosed", "expected a configuration file"),
    (b"a: " + b"x" * 2_000_000, "at most 200000 bytes"),
]


@pytest.mark.parametrize(("content", "expected"), YAML, ids=lambda value: str(value)[:30])
def test_a_configuration_file(content: bytes, expected: str, capsys: Told) -> None:
    Path("c.yaml").write_bytes(content)
    for arguments in (["ablate", "--config=c.yaml"], ["sample", "--pretrained=driving", "--compose=merge", "--settings=c.yaml"]):
        refused(capsys, arguments, "c.yaml", expected)


@pytest.mark.parametrize("verb", ["fit", "invert", "validate", "test", "report", "explain", "study"])
def test_a_configuration_file_of_every_verb(verb: str, capsys: Told) -> None:
    Path("c.yaml").write_text(BOMB)
    refused(capsys, [verb, "--config=c.yaml"], "c.yaml", "expansion")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("stages: [{verb: fit, config: ''}]\nresults: r.csv", "expected a configuration file"),
        ("stages: [{verb: fit, config: nothing.yaml}]\nresults: r.csv", "nothing.yaml"),
        ("stages: [{verb: fly, config: a.yaml}]\nresults: r.csv", "fly"),
        ("stages: 3\nresults: r.csv", "stages"),
        ("stages: [{verb: fit, config: '${unknown}'}]\nresults: r.csv", "unknown"),
    ],
)
def test_a_plan_of_an_ablation(text: str, expected: str, capsys: Told) -> None:
    Path("c.yaml").write_text(text)
    refused(capsys, ["ablate", "--config=c.yaml"], expected)


def test_a_configuration_that_names_an_unknown_key(capsys: Told) -> None:
    Path("c.yaml").write_text("model: {init_args: {seed: '${unknown}'}}")
    refused(capsys, ["fit", "--config", str(CONF / "object_rearrangement.yaml"), "--config=c.yaml"], "unknown")


# Numbers and folders


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (
            ["sample", "--pretrained=driving", "--compose=merge", "--count=1000000000000"],
            "count: expected a number",
        ),
        (
            ["sample", "--pretrained=driving", "--compose=merge", "--count=5000", "--figure=a.png"],
            "count: expected a number",
        ),
        (["sample", "--pretrained=driving", "--compose=merge", "--steps=1000000000000"], "steps: expected a number"),
        (["sample", "--pretrained=driving", "--compose=merge", "--seed=-1"], "seed: expected 0 or more"),
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
