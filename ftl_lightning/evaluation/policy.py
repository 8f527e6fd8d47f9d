"""Receding-horizon policies: plans of a concept, executed in an environment of a domain or of the user."""

import copy
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from ftl_lightning.data.actions import CONTEXT, INITIAL, PRESENT, Regression, action_columns, forward_model, inverse_model
from ftl_lightning.data.deformation import Pinned
from ftl_lightning.data.demonstrations import Demonstrations
from ftl_lightning.data.features import PINNED, Observed, moved
from ftl_lightning.domains.domain import closed_loop_of
from ftl_lightning.evaluation.closed_loop import PlanFollower, planner, sampled_plans
from ftl_lightning.igm.composition import Composition
from ftl_lightning.igm.diffusion import Denoiser
from ftl_lightning.igm.forms.adapter import LowRank
from ftl_lightning.igm.samplers import Sampling
from ftl_lightning.services.errors import UserError, require, short, shown
from ftl_lightning.services.randomness import generator
from ftl_lightning.services.text import Shown, counted
from ftl_lightning.training.concept_model import ConceptModel

STATE = "(state)"  # no user's feature has this name
"""Key of the present states among observed features."""
NAMES = ("state", "states", "observation", "observation.state", "agent_pos")
"""Keys of the present state in an observation that is a dictionary."""
AHEAD = 1, 2, 4, 8
"""Steps ahead of inverse models to choose from."""
POLICY_STEPS = 3
"""Sampler steps of a policy of a user's data, unless given: closed-loop rates are those of 10 steps, in a third of the time."""
REST = 0.2
"""Maximum length of the last step of behaviour that ends at rest, relative to its mean step."""
Control = Callable[[NDArray[np.float32], NDArray[np.float32]], ArrayLike]
"""Controller: ``(present states (episode, state), next planned states (episode, state)) -> actions (episode, action)``."""


class Baked:
    """An adapter whose change of the network is made once, for many samples.

    Args:
        adapter: adapter of a composition.
        denoiser: network of the model.
    """

    def __init__(self, adapter: LowRank, denoiser: torch.nn.Module) -> None:
        self.everywhere = adapter.everywhere
        self._changed = copy.deepcopy(denoiser).requires_grad_(False)
        for name in adapter.factors:
            self._changed.get_parameter(name).copy_(adapter.changed(name, denoiser.get_parameter(name).detach()))

    def __call__(self, denoiser: Denoiser) -> Denoiser:
        """The changed network."""
        return self._changed


def baked(model: ConceptModel, concept: Composition) -> Composition:
    """The composition to sample alone, with baked adapters."""
    alone, denoiser = concept.uncomposed, getattr(model, "denoiser", None)
    if not isinstance(denoiser, torch.nn.Module) or not all(isinstance(adapter, LowRank) for adapter in alone.adapters):
        return alone
    return alone.with_adapters(tuple(Baked(adapter, denoiser) for adapter in alone.adapters if isinstance(adapter, LowRank)))


class Follower(Protocol):
    """Policy of episodes in lockstep.

    Attributes:
        followed: plan ``(horizon, state)`` at each step, by episode.
    """

    followed: dict[int, list[Tensor]]

    def __call__(self, observed: Observed, rows: list[int], step: int, /) -> Tensor:
        """Actions ``(episode, action)`` of some episodes (``rows``) for their observed features ``(episode, *shape)``."""
        ...


class Acting:
    """How actions are obtained from plans of a user's data.

    With a controller, or without actions in the demonstrations, from the next planned state. Where plans are windows from the
    present state, actions are those of the plan. Otherwise actions are those of the plan, or of an inverse model of the present
    state and the planned state some steps ahead: whichever follows plans of training concepts best, in a simulation by a forward
    model. All models are regressions on the demonstrations that the model keeps.

    Args:
        model: model of a user's data.
        control: controller; ``None`` for none.
        sampling: sampler of the plans that are simulated.

    Attributes:
        whole, rests: whether plans are whole demonstrations, and whether these end at rest.
    """

    def __init__(self, model: ConceptModel, control: Control | None, sampling: Sampling) -> None:
        columns = model.domain.plans.columns
        self.actions = list(action_columns(columns))
        self.states = [column for column in range(len(columns)) if column not in self.actions]
        self._control, self._ahead = control, 1
        examples = model.examples
        assert examples is not None
        self.whole = int(examples.lengths.max()) <= model.horizon
        self.rests = self.whole and _ends_at_rest(examples)
        self._inverse: Regression | None = None
        if control is not None:
            self.words = ["actions by the given controller", "from the next planned state"]
        elif not self.actions:
            self.words = ["actions are the next planned state", "as demonstrations have no actions"]
        elif PRESENT in model.domain.observed:
            self.words = ["actions as planned from the present state"]
        else:
            self._choose(model, sampling)

    def _choose(self, model: ConceptModel, sampling: Sampling) -> None:
        """Choose how plans are followed best."""
        examples = model.examples
        assert examples is not None
        draws = [generator("cpu", 0, 2, row) for row in range(len(examples))]
        seen = moved(examples.initial_states.observed, model.device)
        plans = model.sample([model[text] for text in examples.concepts], 1, sampling, draws, seen)[:, 0].cpu()
        parts = examples.states[..., self.states], examples.states[..., self.actions], examples.lengths
        world, spread = forward_model(*parts), plans[..., self.states].flatten(0, 1).var(dim=0).sum().clamp(min=1e-12)
        errors: dict[int, float] = {}
        models: dict[int, Regression | None] = {
            0: None,
            **{ahead: inverse_model(*parts, ahead) for ahead in AHEAD if ahead < model.horizon},
        }
        for self._ahead, self._inverse in models.items():
            state, apart = plans[:, 0, self.states].double(), []
            for age in range(model.horizon - 1):
                action = self(state.float(), plans, age)
                state = state + world(torch.cat((state, action.double()), dim=1))
                apart.append((state - plans[:, age + 1, self.states]).square().sum(dim=1).mean())
            errors[self._ahead] = float(torch.stack(apart).mean() / spread)
        self._ahead = min(errors, key=lambda ahead: errors[ahead])
        self._inverse = models[self._ahead]
        source = f"by an inverse model, {counted(self._ahead, 'step')} ahead" if self._ahead else "as planned"
        self.words = [f"actions {source}", f"simulated error {errors[self._ahead]:.2g} of the variance"]

    def __call__(self, present: Tensor, plans: Tensor, age: int) -> Tensor:
        """Actions ``(episode, action)`` at a time (``age``) of plans ``(episode, horizon, column)``."""
        last = plans.shape[1] - 1
        following = plans[:, min(age + max(self._ahead, 1), last), self.states]
        if self._control is not None:
            return torch.as_tensor(np.asarray(self._control(present.numpy(), following.numpy()), dtype=np.float32))
        if self._inverse is not None:
            return self._inverse(torch.cat((present.double(), following.double() - present.double()), dim=1))
        return plans[:, min(age, last), self.actions] if self.actions else following


class Plans:
    """Follow plans of a user's data, which are sampled again every few steps, with the same noise in an episode.

    Plans as long as demonstrations begin where the episode does, with what is observed there, and pass the present state. At its
    end such a plan is held if demonstrations end at rest; otherwise another one begins. Shorter plans begin at the present state,
    with what is observed now.

    Args:
        model: model of a user's data.
        concept: composition.
        seed: seed of the noise; each episode has a generator.
        sampling: sampler, steps and temperature.
        acting: see :class:`Acting`.
        execute: number of steps between plans.
    """

    def __init__(
        self, model: ConceptModel, concept: Composition, seed: int, sampling: Sampling, acting: Acting, execute: int
    ) -> None:
        self._model, self._concept, self._seed, self._sampling = model, concept, seed, sampling
        self._acting, self._execute = acting, execute
        self._first: dict[int, dict[str, Tensor]] = {}
        self._past: dict[int, Tensor] = {}
        self._begun = 0
        self.followed: dict[int, list[Tensor]] = {}

    def __call__(self, observed: Observed, rows: list[int], step: int) -> Tensor:
        last = self._model.horizon - 1
        if PRESENT in self._model.domain.observed:
            observed = {**observed, PRESENT: self._history(observed[STATE], rows)}
        whole, rests = self._acting.whole, self._acting.rests
        begins = step - self._begun >= last and not rests if whole else step % self._execute == 0
        if step == 0 or begins:
            self._begun = step
            self._first |= {row: {name: values[index] for name, values in observed.items()} for index, row in enumerate(rows)}
        age, present = step - self._begun, observed[STATE]
        if age == 0 or (age % self._execute == 0 and age < last):
            plans = self._sampled(rows, present, age)
        else:
            plans = torch.stack([self.followed[row][-1] for row in rows])
        for row, plan in zip(rows, plans, strict=True):
            self.followed.setdefault(row, []).append(plan)
        return self._acting(present, plans, age)

    def _history(self, present: Tensor, rows: list[int]) -> Tensor:
        """The last states of each episode ``(episode, history * state)``; the first state is repeated."""
        size = self._model.domain.observed[PRESENT].shape[0]
        for row, state in zip(rows, present, strict=True):
            past = self._past.get(row, state.repeat(size // len(state)))
            self._past[row] = torch.cat((past[len(state) :], state))
        return torch.stack([self._past[row] for row in rows])

    def _sampled(self, rows: list[int], present: Tensor, age: int) -> Tensor:
        """Plans ``(episode, horizon, state)`` that pass the present state at a time (``age``)."""
        model, device = self._model, self._model.device
        draws = [generator("cpu", self._seed, 1, row) for row in rows]
        features = {name: torch.stack([self._first[row][name] for row in rows]) for name in model.domain.observed}
        known = torch.full((len(rows), model.horizon, len(model.domain.plans.columns)), torch.nan)
        known[:, age, self._acting.states] = present.float()
        pinned = features if model.max_steps is None else {**features, PINNED: known}
        parts = [self._concept.drawn(draw) for draw in draws]
        plans = model.sample(parts, 1, self._sampling, draws, moved(pinned, device))[:, 0]
        if model.max_steps is None:  # a method whose samples are not pinned
            values, before = (model.encode(states.to(device), moved(features, device)) for states in (known, plans))
            mask = ~values.isnan() & (torch.arange(model.horizon, device=device) == age)[:, None]
            plans = model.decode(Pinned(mask, values.nan_to_num())(before), moved(features, device))
        return plans.cpu()


def _ends_at_rest(examples: Demonstrations) -> bool:
    """Whether most demonstrations end at rest."""
    ends = []
    for path, length in zip(examples.states, examples.lengths.tolist(), strict=True):
        steps = path[:length].diff(dim=0).norm(dim=1)
        ends.append(bool(len(steps) < 2 or steps[-1] <= REST * steps.mean()))
    return sum(ends) * 2 > len(ends)


class Policy(Shown):
    """Receding-horizon policy of a concept, for one environment or a batch of them in lockstep.

    Attributes:
        words: how actions are obtained.
    """

    def __init__(
        self,
        model: ConceptModel,
        concept: Composition,
        sampling: Sampling,
        execute: int,
        act: Control | None = None,
        observe: Callable[[Any], Any] | None = None,
        seed: int = 0,
    ) -> None:
        self.model, self.concept, self.execute = model, baked(model, concept), execute
        self._sampling, self._observe, self._seed = sampling, observe, seed
        # A user's data have examples and no environment.
        self._acting = Acting(model, act, sampling) if model.domain.closed_loop is None and model.examples is not None else None
        if self._acting is None:
            closed_loop_of(model.domain)
            require(act is None, "act", f"none, as {model.domain.name} has a planner", "a controller")
        self.words = ["actions by the domain's planner"] if self._acting is None else self._acting.words
        self._following: Follower | None = None
        self._step, self._batch = 0, False

    def _words(self) -> Iterator[str]:
        yield repr(self.model.domain.name)
        yield f"a plan every {counted(self.execute, 'step')}"
        yield from self.words

    def following(self, count: int, seed: int) -> Follower:
        """Policy of ``count`` episodes in lockstep, whose noise depends on seed and episode."""
        if self._acting is not None:
            return Plans(self.model, self.concept, seed, self._sampling, self._acting, self.execute)
        draws = [generator("cpu", seed, 1, episode) for episode in range(count)]
        make = sampled_plans(self.model, [self.concept] * count, self._sampling, draws)
        return PlanFollower(make, planner(self.model, closed_loop_of(self.model.domain)), self.execute)

    def reset(self, seed: int | None = None) -> None:
        """Begin new episodes; ``seed`` is that of the noise, the last one if ``None``."""
        self._seed = self._seed if seed is None else seed
        self._following, self._step = None, 0

    def act(self, observation: Any) -> NDArray[np.float32]:
        """Action ``(action,)`` for an observation, or ``(episode, action)`` for a batch of observations.

        Args:
            observation: a dictionary of observed features by name and, for a user's data, of the present state, named ``state``
                or ``observation``; or a vector: the present state, followed by observed features in the model's order.

        Raises:
            UserError: for an observation that lacks a feature or has another shape.
        """
        observed, batch = self.observed(observation)
        count = len(next(iter(observed.values())))
        if self._following is None:
            self._following, self._batch = self.following(count, self._seed), batch
        require(len(self._following.followed) in (0, count), "act", f"a batch of {len(self._following.followed)}", count)
        with torch.inference_mode():
            actions = self._following(observed, list(range(count)), self._step).numpy().astype(np.float32)
        for plans in self._following.followed.values():
            del plans[:-1]  # an episode may be long
        self._step += 1
        return actions if batch else actions[0]

    @property
    def plan(self) -> Tensor | None:
        """Present plan ``(horizon, state)``, or ``(episode, horizon, state)`` of a batch; ``None`` before the first action."""
        if self._following is None or not self._following.followed:
            return None
        plans = torch.stack([plans[-1] for plans in self._following.followed.values()])
        return plans if self._batch else plans[0]

    def observed(self, observation: Any) -> tuple[dict[str, Tensor], bool]:
        """Observed features ``(episode, *shape)`` by name, with the present state, and whether the observation is a batch.

        Raises:
            UserError: for an observation that lacks a feature or has another shape.
        """
        given = observation if self._observe is None else self._observe(observation)
        features = self.model.domain.observed
        shapes = {name: feature.shape for name, feature in features.items() if name != PRESENT}  # made of the states
        if self._acting is None:
            require(isinstance(given, Mapping), "observation", f"a dictionary of {', '.join(features)}", type(given).__name__)
            return _by_shape({name: given.get(name) for name in features}, shapes)
        shapes[STATE] = (len(self._acting.states),)
        starts = {*self.model.starts}
        if isinstance(given, Mapping):
            values = {name: given[name] for name in features if name in given}
            vectors = [key for key in NAMES if key in given and key not in features]
            vectors += [key for key, value in given.items() if key not in features and np.shape(value)[-1:] == shapes[STATE]]
            if vectors:
                values |= self._of_columns(_numbers("state", given[vectors[0]])) or {STATE: given[vectors[0]]}
        else:
            vector = _numbers("observation", given)
            values = self._of_columns(vector) or _of_vector(vector, shapes, starts)
        if STATE in values:
            values |= {INITIAL: values[STATE]} if INITIAL in features else {}
        for name, columns in self.model.starts.items():
            if name not in values and STATE in values:
                values[name] = _numbers("state", values[STATE])[..., [self._acting.states.index(column) for column in columns]]
        return _by_shape({name: values.get(name) for name in shapes}, shapes)

    def _of_columns(self, vector: Tensor) -> dict[str, Tensor]:
        """State and context of an observation ``(..., size)`` whose numbers are the columns of the file; empty for others."""
        assert self._acting is not None
        context = next((name for name in self.model.domain.observed if name.startswith(CONTEXT)), "")
        columns = [self.model.domain.plans.columns[column] for column in self._acting.states]
        still = context.removeprefix(CONTEXT).split(",") if context else []
        whole = [*columns, *still]
        if not context or not all(map(str.isdigit, whole)) or vector.shape[-1:] != (len(whole),):
            return {}
        order = sorted(whole, key=int)
        parts = {STATE: columns, context: still}
        return {name: vector[..., [order.index(column) for column in names]] for name, names in parts.items()}


def _of_vector(vector: Tensor, shapes: Mapping[str, tuple[int, ...]], starts: Collection[str]) -> dict[str, Any]:
    """Parts of a vector ``(..., size)``: the state, then observed features in order, without those that equal the first state."""
    parts = {STATE: shapes[STATE], **{name: shape for name, shape in shapes.items() if name != STATE and name not in starts}}
    sizes = [int(np.prod(shape)) for shape in parts.values()]
    words = " + ".join(f"{size} ({'state' if name == STATE else name})" for name, size in zip(parts, sizes, strict=True))
    require(vector.shape[-1:] == (sum(sizes),), "observation", f"a vector of {words} numbers; give observe=", tuple(vector.shape))
    every = vector.split(sizes, dim=-1)
    return {name: part.unflatten(-1, parts[name]) for name, part in zip(parts, every, strict=True)}


def _numbers(place: str, value: Any) -> Tensor:
    try:
        array = np.asarray(value)
        tensor = torch.from_numpy(np.array(array, dtype=np.uint8 if array.dtype == np.uint8 else np.float32))
    except (TypeError, ValueError):
        raise UserError(f"{place}: expected numbers, found {shown(value)}") from None
    require(bool(tensor.isfinite().all()), place, "finite numbers", "others")
    return tensor


def _by_shape(values: Mapping[str, Any], shapes: Mapping[str, tuple[int, ...]]) -> tuple[dict[str, Tensor], bool]:
    """Tensors ``(episode, *shape)``, and whether they were a batch."""
    observed, batches = {}, set()
    for name, value in values.items():
        label = "the present state (key 'state')" if name == STATE else repr(short(name))
        require(value is not None, "observation", f"{label} of shape {shapes[name]}; give observe=", "none")
        tensor = _numbers(f"observation {label}", value)
        batches.add(tensor.dim() > len(shapes[name]))
        tensor = tensor if tensor.dim() > len(shapes[name]) else tensor[None]
        require(tensor.shape[1:] == shapes[name], "observation", f"{label} of shape {shapes[name]}", tuple(tensor.shape[1:]))
        observed[name] = tensor
    require(len(batches) == 1, "observation", "a batch of every feature, or of none", "both")
    return observed, batches.pop()
