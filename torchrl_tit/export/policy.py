"""Writes a policy to a file that acts without this library, and checks the file."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, TargetReturn

from torchrl_tit.export.comparison import COPIES, compare
from torchrl_tit.export.formats import find_format, trace
from torchrl_tit.export.parts import Entry, read_parts, transforms_of
from torchrl_tit.export.program import Program, make_program
from torchrl_tit.files import whole_or_not_at_all
from torchrl_tit.networks.building import evaluating

VERSION = 1
"""Version of the facts in a file."""


def export_policy(
    policy: TensorDictModuleBase,
    make_env: Callable[[int], EnvBase],
    path: Path | str,
    *,
    step_by_step: bool = False,
    sample: bool = False,
    facts: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Writes a policy to a file that needs neither this library nor TorchRL.

    The file holds everything between the task's observation and its action: normalization, hidden
    velocities, the network, the choice of an action and its clipping. It reads what other
    transforms of the environment write, such as TorchRL's `ObservationNorm`: they are not in the
    file. The batch size N is free, but at least 1; weights are float32, on a CPU. A policy that
    reads K > 1 observations can have two forms:

    - by default, it reads the last K observations, ``history`` [N, K, *obs], and carries no state;
    - with ``step_by_step``, it reads the newest ``observation`` [N, *obs], whether an episode
      begins (``is_init`` bool [N]) and the tokens of the previous K - 1 frames, and writes the
      tokens to pass on. So each frame is encoded once.

    A recurrent policy always has the second form, with its state instead of tokens. A policy that
    reads one observation takes just that in both forms.

    After writing, the file is read again and compared with the live policy on 100 observations of
    the live policy's episodes.

    Args:
        policy: a :class:`~torchrl_tit.modules.Backbone` and the modules after it, on a CPU. What
            is exported is its evaluation mode.
        make_env: makes the environment in which the policy acts, given the number of copies.
        path: the file to write, which must not exist yet: "NAME.pt2" (`torch.export`) or
            "NAME.onnx".
        step_by_step: whether each frame is encoded only once.
        sample: whether actions are sampled, from an input "noise", instead of being the most likely
            ones.
        facts: further entries of the facts in the file.

    Returns:
        The facts: "inputs" and "outputs" by name with "shape" (without the batch) and "dtype",
        "state" (the inputs to carry over, whose new values are the outputs "next_NAME"), "noise"
        (the name of NumPy's generator that draws it), "num_frames", and the "difference" that was
        found.

    Raises:
        FileExistsError: if the file exists already.
        ValueError: if the policy is of another kind, the format cannot express it, a package is
            missing, or the file acts differently. Then no file is left.

    Example:
        >>> import tempfile
        >>> from tensordict.nn import TensorDictSequential
        >>> from torchrl.data import Categorical
        >>> from torchrl_tit import Backbone, EnhancedTIT
        >>> from torchrl_tit.envs import make_env
        >>> from torchrl_tit.modules import make_actor
        >>> tit = EnhancedTIT(observation_shape=(4,), num_frames=8, num_blocks=1)
        >>> policy = TensorDictSequential(Backbone(tit), make_actor(64, Categorical(2))).eval()
        >>> path = tempfile.mkdtemp() + "/policy.pt2"
        >>> task = lambda copies: make_env("CartPole-v1", copies, num_frames=8)
        >>> facts = export_policy(policy, task, path, step_by_step=True)
        >>> list(facts["inputs"]), facts["state"]
        (['observation', 'is_init', 'tokens'], ['tokens'])
        >>> exported = torch.export.load(path).module()
        >>> first = torch.ones(1, dtype=torch.bool)
        >>> outputs = exported(
        ...     observation=torch.zeros(1, 4), is_init=first, tokens=torch.zeros(1, 7, 1, 32)
        ... )
        >>> outputs["action"].shape, outputs["next_tokens"].shape
        (torch.Size([1]), torch.Size([1, 7, 1, 32]))
    """
    path = Path(path)
    kind = find_format(path)
    kind.check_installed()
    with whole_or_not_at_all(path) as hidden, closing(make_env(COPIES)) as env, evaluating(policy):
        parts = read_parts(policy, env)
        precision, parts.backbone.autocast = parts.backbone.autocast, None
        try:
            program = make_program(parts, step_by_step=step_by_step, sample=sample)
            # A copy, because tracing modifies the weights of some layers, such as nn.LSTM.
            exported = trace(copy.deepcopy(program))
            said = {**_describe(program, env), **(facts or {})}
            kind.write(exported, said, hidden)
            with torch.random.fork_rng(devices=[]):  # seeding an environment seeds PyTorch
                difference = compare(kind.read(hidden), program, policy, env)
        finally:
            parts.backbone.autocast = precision
    return {**said, "difference": difference}


def _describe(program: Program, env: EnvBase) -> dict[str, Any]:
    """Describes a program's inputs and outputs in a form suitable for JSON."""
    examples = program.examples(1)
    with torch.no_grad():
        outputs = program(examples)
    made = {name: Entry(tuple(x.shape[1:]), x.dtype) for name, x in outputs.items()}
    said: dict[str, Any] = {
        "version": VERSION,
        "inputs": {name: _written(entry) for name, entry in program.inputs.items()},
        "outputs": {name: _written(entry) for name, entry in made.items()},
        "state": program.state,
        "noise": program.noise,
        "num_frames": program.num_frames,
        "padding": program.parts.observed[0].padding,
        "torch": torch.__version__,
    }
    targets = [t.target_return for t in transforms_of(env) if isinstance(t, TargetReturn)]
    return {**said, **({"target_return": float(targets[0])} if targets else {})}


def _written(entry: Entry) -> dict[str, Any]:
    return {"shape": list(entry.shape), "dtype": str(entry.dtype).removeprefix("torch.")}
