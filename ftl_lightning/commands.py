"""The verbs that need no trainer: plain typed functions. Their imports are inside, so that each starts at once."""

from pathlib import Path
from typing import Literal

from ftl_lightning.ablation import Stage


def generate(
    domain: str, task: str = "", count: int = 100, seed: int = 0, workers: int = 1, out: str = "demonstrations.safetensors"
) -> None:
    """Draw demonstrations of a task into a file.

    Args:
        domain: name of a domain.
        task: in words, for example "circle right of square and triangle above square"; empty for every training concept.
        count: demonstrations of the task, or of each training concept.
        seed: the same seed gives the same bytes.
        workers: processes, in domains whose expert takes long; a run that was stopped goes on where it was.
        out: file to write.
    """
    from ftl_lightning.domains.domain import load_domain
    from ftl_lightning.errors import UserError

    if count < 1:
        raise UserError(f"count: expected 1 or more, found {count}")
    if seed < 0:
        raise UserError(f"seed: expected 0 or more, found {seed}")
    if workers < 1:
        raise UserError(f"workers: expected 1 or more, found {workers}")
    source = load_domain(domain)
    demonstrations = source.generate(task, count, seed, workers) if task else source.training_set(count, seed)
    demonstrations.save(out)
    print(f"{out}: {len(demonstrations)} demonstrations of {task or f'{len(source.training_concepts)} training concepts'}")


def encode(domain: str, encoder: str = "minilm", revision: str = "main", out: str = "") -> None:
    """Make a domain's table of concept embeddings with a language model.

    Args:
        domain: name of a domain.
        encoder: "minilm" (the extra), or the name or path of a T5 or BERT-like model.
        revision: of a Hugging Face model.
        out: file to write; empty for the table that ships with the domain.
    """
    from ftl_lightning.concepts.encoder import load_encoder, write_table
    from ftl_lightning.domains.domain import load_domain

    source = load_domain(domain)
    path = Path(out) if out else source.table
    write_table(path, load_encoder(encoder, source.table, revision), source.descriptions)
    print(path)


def sample(
    pretrained: str,
    concept: str = "",
    compose: str = "",
    count: int = 50,
    seed: int = 0,
    sampler: Literal["ddpm", "ddim", "dpm_solver"] = "ddpm",
    steps: int = 100,
    temperature: float = 0.1,
    goal: str = "",
    initial: str = "",
    out: str = "states.safetensors",
    figure: str = "",
    execute: bool = False,
    replan: int = 8,
    animation: str = "",
) -> None:
    """Generate behaviour from a learned concept, composed with training concepts.

    Args:
        pretrained: folder of the pretrained model.
        concept: file of a learned concept; empty for training concepts alone.
        compose: what is composed with it, with guidance weights: "circle right of square:1.2 + other.safetensors:0.9". Training
            concepts, or files of learned concepts, whose own weights are multiplied. A weight may be left out and is 1 then.
        count: samples.
        seed: of the samples.
        sampler: see ftl_lightning.diffusion.samplers.
        steps: of the sampler.
        temperature: the paper's alpha; lower is less diverse and more accurate.
        goal: judge the samples by this task and print their accuracy. In domains with initial states, new ones of this task are
            drawn from the seed.
        initial: demonstrations file whose initial states are used instead; one sample of each.
        out: demonstrations file to write.
        figure: picture to write, .png or .svg.
        execute: also execute the concept in closed loop from the same initial states, in domains that can, and say how the
            episodes ended.
        replan: steps that a plan is followed before a new one is made; the paper's number is 1.
        animation: .gif to write of the first executed episode.
    """
    import torch

    from ftl_lightning.concepts.composition import parse_composition
    from ftl_lightning.concepts.concept import Concept
    from ftl_lightning.demonstrations.container import Demonstrations
    from ftl_lightning.diffusion.samplers import SAMPLERS
    from ftl_lightning.domains.domain import load_domain
    from ftl_lightning.errors import UserError
    from ftl_lightning.evaluation.closed_loop import Following, planner, roll_out, sampled_plans
    from ftl_lightning.evaluation.tensorboard import gif
    from ftl_lightning.learning.pretrained import load_model
    from ftl_lightning.seeding import generator
    from ftl_lightning.tensor_file import atomic

    model = load_model(pretrained)
    domain = load_domain(model.config.domain)
    if count < 1:
        raise UserError(f"count: expected 1 or more, found {count}")
    if model.max_steps is not None and not 1 <= steps <= model.max_steps:
        raise UserError(f"steps: expected 1 to {model.max_steps} (the model's T), found {steps}")
    if seed < 0 or temperature < 0:
        raise UserError(f"seed, temperature: expected 0 or more, found {min(seed, temperature)}")
    if goal and not domain.reads(goal):
        raise UserError(f"goal: expected a task of {domain.name}, found {goal!r}")
    if replan < 1:
        raise UserError(f"replan: expected 1 or more, found {replan}")
    if animation and not (execute and animation.endswith(".gif")):
        raise UserError(f"animation: expected a name that ends in .gif, and --execute true, found {animation!r}")
    if execute and domain.closed_loop is None:
        raise UserError(f"execute: expected a domain with an environment, found {domain.name}, which has none")
    if figure and Path(figure).suffix not in (".png", ".svg", ".pdf"):
        raise UserError(f"figure: expected a name that ends in .png, .svg or .pdf, found {figure!r}")
    if initial:
        given = Demonstrations.load(initial)
        starts = given.first_initial_states
        count = len(given)
    elif domain.initial_states is None:
        starts = None
    elif goal:
        starts = domain.initial_states(goal, count, seed)
    else:
        raise UserError(
            f"goal, initial: expected a task or a demonstrations file to start from (domain {domain.name}), found neither"
        )
    model.encode_initial(starts)
    embeddings, weights = [], []
    for name, weight in [*parse_composition(compose), *([(concept, 1.0)] if concept else [])]:
        if name == concept or name.endswith(".safetensors"):
            learned = Concept.load(name)
            model.check(learned, name)
            embeddings += list(learned.embeddings)
            weights += (weight * learned.weights).tolist()
        else:
            embeddings.append(model.concept(name))
            weights.append(weight)
    if not embeddings:
        raise UserError("concept, compose: expected a learned concept, training concepts or both, found neither")
    states = model.sample(
        [torch.stack(embeddings)],
        [torch.tensor(weights)],
        count,
        SAMPLERS[sampler],
        steps,
        temperature,
        [generator("cpu", seed)],
        starts,
    )[0]
    result = Demonstrations(
        states=states,
        lengths=torch.full((count,), model.config.horizon),
        domain=domain.name,
        state_names=domain.state_names,
        state_units=domain.state_units,
        concepts=(goal,) * count,
        initial_states=starts,
        provenance={"pretrained": model.hash, "concept": concept, "compose": compose, "seed": seed, "temperature": temperature},
    )
    result.save(out)
    print(f"{out}: {count} samples")
    right = domain.succeeded(goal, states, starts) if goal and domain.succeeded else None
    if right is not None:
        print(f"accuracy on '{goal}': {right.float().mean():.2f}")
    if figure:
        with atomic(figure) as temporary:
            domain.render(states, None if right is None else right.tolist(), goal or "samples", starts).savefig(temporary, dpi=110)
        print(figure)
    if execute and domain.closed_loop is not None and starts is not None:
        plan = sampled_plans(
            model,
            [torch.stack(embeddings)] * count,
            [torch.tensor(weights)] * count,
            SAMPLERS[sampler],
            steps,
            temperature,
            [generator("cpu", seed, 1, episode) for episode in range(count)],
        )
        policy = Following(plan, planner(model, domain.closed_loop), replan)
        rollout = roll_out(domain.closed_loop, starts, policy)
        if goal:
            for name, values in domain.closed_loop.judge(goal, rollout.observations, rollout.infos).items():
                print(f"closed loop, {name}: {values.float().mean():.2f} of {count} episodes")
        if animation:
            with atomic(animation) as temporary:
                temporary.write_bytes(gif(domain.closed_loop.frames(rollout.observations[0], torch.stack(policy.followed[0]))))
            print(animation)


def explain(concept: str, pretrained: str = "", nearest: int = 3) -> None:
    """Say in words what a learned concept is made of: its nearest training concepts and their best non-negative combination.

    Args:
        concept: file of a learned concept.
        pretrained: folder of the model that it was learned with; empty to look for it in pretrained and logs.
        nearest: how many of the nearest training concepts are told.
    """
    from ftl_lightning.concepts.concept import Concept
    from ftl_lightning.concepts.explanation import explain as explained
    from ftl_lightning.errors import UserError
    from ftl_lightning.learning.pretrained import find_model, load_model

    if nearest < 1:
        raise UserError(f"nearest: expected 1 or more, found {nearest}")
    learned = Concept.load(concept)
    model = load_model(pretrained or find_model(learned.origin.pretrained, (Path("pretrained"), Path("logs"))))
    model.check(learned, concept)
    names = model.config.training_concepts
    print(f"{learned.origin.name}: learned from {learned.origin.count} demonstrations of {learned.origin.domain}")
    parts = [(f"component {number}, weight {weight:.2f}", embedding) for number, (weight, embedding) in learned.numbered()]
    if len(parts) > 1:
        parts.append(("weighted sum", learned.weights @ learned.embeddings))
    for name, embedding in parts:
        print(f"{name}: {explained(embedding, names, model.training_embeddings, nearest)}")


def ablate(
    stages: list[Stage],
    results: str,
    seeds: list[int] = [0],  # noqa: B006 (never changed)
    shard: str = "1/1",
    executor: Literal["local", "ray"] = "local",
) -> None:
    """Run every cell of an ablation that the results do not hold yet.

    Args:
        stages: verbs with grids of options, in order.
        results: results file that rows are added to.
        seeds: each stage runs once a seed.
        shard: "3/8" for the third of eight parts; models that it needs and does not make itself must be there.
        executor: "ray" (the extra "cluster") runs cells side by side on a Ray cluster, or on this machine's processors.
    """
    from ftl_lightning.ablation.run import run_ablation

    run_ablation(stages, seeds, results, shard, executor)


def report(results: str = "results", out: str = "results/report", readme: str = "") -> None:
    """Tables and figures from results, beside the paper's numbers.

    Args:
        results: a results file, or a folder of them.
        out: folder for Markdown, LaTeX and figures.
        readme: a Markdown file to update between its marks.
    """
    from ftl_lightning.reporting.report import write_report

    print(write_report(Path(results), Path(out), Path(readme) if readme else None))
    print(f"written to {out}")
