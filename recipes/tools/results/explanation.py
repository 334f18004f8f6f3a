"""What a trained agent looks at: explained steps, and films and pictures of them."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, distributions
from torchrl.envs import EnvBase

from torchrl_tit.analysis import (
    Target,
    grad_cam,
    integrated_gradients,
    map_attention,
    outer_attention,
)
from torchrl_tit.analysis.layers import image_layers
from torchrl_tit.analysis.targets import find_network, histories_of, run_policy
from torchrl_tit.evaluation import evaluate
from torchrl_tit.networks.building import evaluating

from .explained_page import Choice, ExplainedStep, Page, Seen
from .film import FILMS, make_rendered, new_film, take_picture

MapKind = Literal["grad-cam", "integrated-gradients", "attention"]


class Explainer:
    """Explains steps of a policy.

    Args:
        policy: the policy.
        target: what is explained; see :data:`~torchrl_tit.analysis.targets.Target`.
        kind: kind of maps: Grad-CAM of images, integrated gradients, or attention rolled out over
            the inner blocks. By default Grad-CAM of images that a convolution or an inner
            transformer reads, and integrated gradients of everything else but categories.
        layer: name of another layer for Grad-CAM.

    Raises:
        ValueError: if the policy has no network of this library, or ``layer`` is for other maps.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        *,
        target: Target = "action",
        kind: MapKind | None = None,
        layer: str | None = None,
    ) -> None:
        if layer is not None and kind not in (None, "grad-cam"):
            raise ValueError(f"a layer is for grad-cam, not for {kind}: leave one of them out")
        self.policy, self.target, self.layer = policy, target, layer
        self.network = find_network(policy, target)
        self.kind = "grad-cam" if layer is not None else kind

    def explain(self, tensordict: TensorDictBase) -> ExplainedStep:
        """Explains a step.

        Args:
            tensordict: tensordict of one environment, [1], after the policy has acted.

        Raises:
            ValueError: if there are no such maps for this network, or its policy does not compute
                the target.
        """
        state = tensordict.detach()
        with evaluating(self.policy), torch.no_grad():
            outputs, distribution = run_policy(self.policy, state)
        histories = histories_of(self.policy, state)
        seen = {}
        encoders = zip(self.network.observations, self.network.frames, histories, strict=False)
        frames = {name: encoder.clean(history) for name, encoder, history in encoders}
        for name, maps in self._maps(state, histories).items():
            seen[name] = Seen(_array(frames[name][0]), _array(maps[0]))
        try:
            attention = _array(outer_attention(self.network, *histories)[0])
        except ValueError:  # there is none
            attention = None
        return ExplainedStep(
            seen, attention, describe_choice(outputs, distribution), read_value(outputs)
        )

    def _maps(self, state: TensorDictBase, histories: Sequence[Tensor]) -> dict[str, Tensor]:
        """The maps by the name of the observation, [1, K or 1, ...] each."""
        if self.kind == "attention":
            kinds = {name: seen.kind for name, seen in self.network.observations.items()}
            maps = map_attention(self.network, *histories)
            return {k: x if kinds[k] == "image" else x.flatten(-2) for k, x in maps.items()}
        if self.kind == "grad-cam":
            return grad_cam(self.policy, state, target=self.target, layer=self.layer)
        rest = {n for n, seen in self.network.observations.items() if seen.kind != "categories"}
        found: dict[str, Tensor] = {}
        if self.kind is None and (images := image_layers(self.network)):
            found = grad_cam(self.policy, state, target=self.target)
            rest -= set(images)
        if rest:
            shares = integrated_gradients(self.policy, state, target=self.target)
            for name in rest:
                observation = self.network.observations[name]
                share = shares[name]
                if observation.kind == "image":  # channels of a pixel count together
                    share = share.abs().flatten(2, -3).sum(2) if share.ndim > 4 else share.abs()
                found[name] = share
        return {name: found[name] for name in self.network.observations if name in found}


def describe_choice(
    outputs: TensorDictBase, distribution: distributions.Distribution | None
) -> Choice:
    """Describes an action and what it was chosen from.

    Args:
        outputs: what the policy wrote, [1].
        distribution: distribution of its actions, if there is one.
    """
    action = outputs["action"][0]
    base: Any = getattr(distribution, "base_dist", distribution)
    title, labels, spreads = "action probabilities", None, None
    if action.is_floating_point():
        title, heights = "action", action.flatten()
        chosen = [True] * len(heights)
        if isinstance(base, distributions.Normal):
            title, spreads = "action, and its spread", _array(base.scale[0].flatten())
    elif distribution is None:
        title, heights = "values of actions", outputs["action_value"][0]
        forbidden = heights == torch.finfo(heights.dtype).min  # what TorchRL writes for them
        heights = heights.masked_fill(forbidden, torch.nan)
        chosen = [i == int(action) for i in range(len(heights))]
    elif isinstance(base, distributions.Bernoulli):
        title, heights = "probabilities of on", base.probs[0].flatten()
        chosen = action.flatten().bool().tolist()
    elif base.probs.ndim == 2:
        heights = base.probs[0]
        index = int(action.int().argmax()) if action.ndim else int(action)
        chosen = [i == index for i in range(len(heights))]
    else:  # several choices; one with fewer options than another is padded
        rows = base.probs[0].flatten(0, -2)
        exists = getattr(distribution, "exists", torch.ones_like(base.probs))
        options = exists[0].flatten(0, -2).int().sum(-1).tolist()
        labels = [f"{i}: {option}" for i, count in enumerate(options) for option in range(count)]
        heights = torch.cat([row[:count] for row, count in zip(rows, options, strict=True)])
        likely = rows.argmax(-1).tolist()
        chosen = [option == likely[i] for i, n in enumerate(options) for option in range(n)]
    labels = labels or [str(i) for i in range(len(heights))]
    return Choice(title, labels, _array(heights), spreads, chosen)


def read_value(outputs: TensorDictBase) -> float | None:
    """Returns the value that a policy wrote, if it computes any: the state's, or the action's."""
    for key in ("state_value", "chosen_action_value"):
        value = outputs.get(key, None)
        if value is not None:
            return float(value.flatten()[0])
    return None


def _array(x: Tensor) -> np.ndarray:
    return x.detach().cpu().numpy()


def explain_episode(
    env: Any,
    explainer: Explainer,
    name: str | Path,
    steps: Sequence[int],
    show: Callable[[int, ExplainedStep, np.ndarray], None],
    *,
    title: str,
    seed: int = 0,
    dpi: int = 80,
    actions: Tensor | None = None,
) -> int:
    """Plays an episode with the most likely actions, and explains some of its steps.

    Args:
        env: the task, of one copy, which can be rendered.
        explainer: what explains the policy.
        name: name of the policy in messages.
        steps: which steps to explain, in order and counted from 0; the episode is not played
            beyond the last one.
        show: called with the number of each of these steps, the step, and its page, uint8 [height,
            width, 3].
        title: title of the pages.
        seed: seed of the episode.
        dpi: dots per inch of the pages.
        actions: the actions that were taken, [T, ...], if they are recorded; by default those of
            the policy.

    Returns:
        The number of steps that were played.
    """
    page: Page | None = None
    values: list[Any] = []
    recent: deque[np.ndarray] = deque(maxlen=explainer.network.num_frames)

    def look(number: int, acted: TensorDictBase) -> None:
        nonlocal page
        values.append(read_value(acted))
        if number > steps[0] - explainer.network.num_frames:
            recent.append(np.asarray(take_picture(env, name)))
        if number in steps:
            step = explainer.explain(acted)
            page = page or Page(step, title, dpi)
            show(number, step, page.draw(step, [*recent], values, number))

    acted = play_steps(env, explainer.policy, steps[0], steps[-1], look, seed=seed, actions=actions)
    return len(acted)


def play_steps(
    env: EnvBase,
    policy: TensorDictModuleBase,
    first: int,
    last: int,
    look: Callable[[int, TensorDictBase], None],
    *,
    seed: int,
    actions: Sequence[Tensor] | Tensor | None = None,
) -> list[Tensor]:
    """Plays an episode with the most likely actions, up to one of its steps.

    Args:
        env: the task, of one copy.
        policy: the policy.
        first: the step, counted from 0, that the episode must reach.
        last: the last step to play.
        look: called at each step with its number and what the policy wrote.
        seed: seed of the episode.
        actions: the actions to take instead of the policy's.

    Returns:
        The actions that were taken; fewer than ``last + 1`` if the episode ended before.

    Raises:
        ValueError: if the episode has no step ``first``.
    """
    taken: list[Tensor] = []

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        number = len(taken)
        acted = policy(tensordict)
        look(number, acted)
        if actions is not None:
            acted["action"] = actions[number].expand_as(acted["action"]).clone()
        taken.append(acted["action"].clone())
        if number == last:
            raise _Enough
        return acted

    with suppress(_Enough):
        evaluate(env, act, 1, seed=seed)
    if len(taken) <= first:
        played = "of the data" if isinstance(actions, Tensor) else f"of seed {seed}"
        raise ValueError(
            f"the episode {played} has {len(taken)} steps, so there is no step {first}: choose one "
            f"below {len(taken)}"
        )
    return taken


class _Enough(Exception):
    """The last step was played."""


def explain_policy(
    make_env: Callable[..., EnvBase],
    policy: TensorDictModuleBase,
    name: str | Path,
    out: Path,
    *,
    seed: int = 0,
    step: int | None = None,
    max_steps: int | None = None,
    title: str | None = None,
    actions: Tensor | None = None,
    **explanation: Any,
) -> int:
    """Shows what a policy looks at while it plays an episode with its most likely actions.

    Args:
        make_env: makes the task, given the number of copies and ``render_mode``.
        policy: the policy.
        name: name of the policy in messages.
        out: the file to write, which must not exist yet: a film (GIF or MP4) of the episode, or a
            picture (PNG) of one step.
        seed: seed of the episode.
        step: for a picture, the step to show, counted from 0, which is the default.
        max_steps: for a film, the maximum number of steps to show; by default the whole episode.
        title: name of the policy on the page; by default ``name``.
        actions: as in :func:`explain_episode`.
        **explanation: arguments of :class:`Explainer`.

    Returns:
        The number of steps that are shown.

    Raises:
        FileExistsError: if there is such a file already.
        ValueError: if the file is of another kind, the episode ends before the step, the task
            cannot be rendered, or there are no such maps for the network.
    """
    check_explanation(out, step, max_steps)
    first = step or 0
    steps = range(first, first + 1) if out.suffix == ".png" else range(max_steps or sys.maxsize)
    explainer = Explainer(policy, **explanation)
    with (
        closing(make_rendered(make_env, name)) as env,
        new_film(out, env.base_env.render_fps) as pictures,
    ):
        count = explain_episode(
            env,
            explainer,
            name,
            steps,
            lambda number, step, page: pictures.append_data(page),
            title=title or str(name),
            seed=seed,
            actions=actions,
        )
    return min(count, steps.stop) - first


def check_explanation(out: Path, step: int | None, max_steps: int | None) -> None:
    """Raises ValueError if a file, or the steps to show in it, are invalid."""
    if out.suffix not in (*FILMS, ".png"):
        raise ValueError(
            f"an explanation is a film (.gif, .mp4) or a picture of one step (.png), not "
            f"{out.name!r}"
        )
    if step is not None and out.suffix in FILMS:
        raise ValueError(f"step {step} is one step, so it is a picture: write it to a .png")
    if max_steps is not None and out.suffix not in FILMS:
        raise ValueError(f"max_steps {max_steps} is the length of a film, not of a .png: use step")
