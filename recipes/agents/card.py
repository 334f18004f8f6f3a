"""The model card of an agent, as the Hugging Face Hub shows it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torchrl_tit.agents.hub import import_hub

from ..recipe import Recipe


@dataclass(frozen=True)
class Facts:
    """The contents of a card.

    Args:
        name: the agent's name.
        source: what ``load_agent`` takes to load it.
        license: identifier of its licence, if one is to be named.
        recipe: the settings of its run.
        steps: the steps that it was trained for.
        evaluation: the returns of its episodes.
        versions: versions of packages, by name.
        parameters: number of the policy's weights.
    """

    name: str
    source: str
    license: str | None
    recipe: Recipe
    steps: int
    evaluation: Mapping[str, Any]
    versions: Mapping[str, Any]
    parameters: int


def make_card(facts: Facts) -> str:
    """Writes the card of an agent: metadata in YAML, and Markdown.

    Args:
        facts: the contents.

    Raises:
        AgentError: if huggingface_hub is missing.
    """
    recipe, evaluation = facts.recipe, facts.evaluation
    backbone = recipe.backbone
    unit = "gradient steps" if recipe.offline else "environment steps"
    data = f", on the data set `{evaluation['dataset']}`" if "dataset" in evaluation else ""
    first = evaluation["seed"]
    last = first + evaluation["episodes"] - 1
    versions = "\n".join(f"| {name} | {version} |" for name, version in facts.versions.items())
    recipe_name = f"`{recipe.name}`, " if recipe.name else ""
    return f"""\
---
{_metadata(facts)}
---

# {facts.name}

An agent for {_task(recipe)}, trained by torchrl-tit with `{recipe.algorithm}` for {facts.steps:,}
{unit}{data}.

| | |
|---|---|
| recipe | {recipe_name}seed {recipe.seed}; all settings are in `recipe.json` |
| frame encoder | `{backbone.frame.name}` |
| history encoder | `{backbone.history.name}` |
| observations that it reads at a time | {backbone.num_frames} |
| weights | {facts.parameters:,}, in `model.safetensors` |

## Evaluation

Mean return **{evaluation["mean"]:.1f} ± {evaluation["std"]:.1f}** (standard deviation) over
{evaluation["episodes"]} whole episodes, each with its own seed ({first} to {last}), always the most
likely action, in the task's own rewards.{_target(evaluation)} The return of each episode is in
`evaluation.json`. This is one run: other seeds of training can end higher or lower.

## Use

```python
import torchrl_tit

agent = torchrl_tit.load_agent("{facts.source}")
env = agent.make_env(8, seed=0)  # with everything that the policy reads
steps = env.rollout(100, agent.policy, break_when_any_done=False)
```

```sh
torchrl-tit play {facts.source} --episodes 10
```

Loading reads JSON and safetensors, checks each file against its SHA-256 in `agent.json`, and
executes nothing.

## Versions

| package | version |
|---|---|
{versions}
"""


def _task(recipe: Recipe) -> str:
    hidden = " without velocities" if getattr(recipe, "hide_velocities", False) else ""
    settings = [*recipe.env_settings, *recipe.wrappers]
    among = f" with {', '.join(f'`{setting}`' for setting in settings)}" if settings else ""
    return f"`{recipe.env}`{hidden}{among}"


def _target(evaluation: Mapping[str, Any]) -> str:
    if "target_return" not in evaluation:
        return ""
    return f" The policy was told to aim for a return of {evaluation['target_return']:g}."


def _metadata(facts: Facts) -> str:
    """The metadata in YAML, written by the Hub's own library."""
    hub = import_hub()
    recipe, evaluation = facts.recipe, facts.evaluation
    task = "reinforcement-learning"
    result = hub.EvalResult(
        task_type=task,
        task_name=task,
        dataset_type=recipe.env,
        dataset_name=recipe.env,
        metric_type="mean_reward",
        metric_name="mean_reward",
        metric_value=f"{evaluation['mean']:.2f} +/- {evaluation['std']:.2f}",
    )
    data = hub.ModelCardData(
        library_name="torchrl-tit",
        license=facts.license,
        pipeline_tag=task,
        tags=[task, "deep-reinforcement-learning", "torchrl", recipe.env, recipe.algorithm],
        model_name=facts.name,
        eval_results=[result],
    )
    return str(data.to_yaml()).strip()
