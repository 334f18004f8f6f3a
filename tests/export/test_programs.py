"""Policies as functions of plain tensors act as the live ones, before they are written."""

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential, set_interaction_type
from tensordict.nn.probabilistic import InteractionType
from torch import nn

from recipes.dqn import DQN
from tests.agents.runs import make_run
from tests.export.policies import make_policy, program_of
from tests.numerics import assert_near
from tests.recipes.ppo import tasks
from tests.recipes.small import tit
from torchrl_tit import load_agent
from torchrl_tit.envs import make_env
from torchrl_tit.export.comparison import COPIES, NotTheSameError, compare
from torchrl_tit.export.parts import Entry, read_parts
from torchrl_tit.export.policy import export_policy
from torchrl_tit.modules import Backbone, make_actor
from torchrl_tit.networks import MLP
from torchrl_tit.settings import (
    GRU,
    LSTM,
    Catformer,
    ChainedOuter,
    CoBERL,
    GatedDeltaNet,
    GTrXL,
    Inner,
    Linear,
    Mamba2,
    MinGRU,
    Outer,
    PairedOuter,
)


def difference(policy, task, **form):
    program = program_of(policy, task, **form)
    env = task(COPIES)
    found = compare(program, program, policy, env, observations=60)
    env.close()
    return found


HISTORIES = {
    "paired": PairedOuter(num_heads=1),
    "chained": ChainedOuter(num_heads=1),
    "relative": Outer(num_blocks=2, num_heads=1, temporal_positions="relative"),
    "rotary": Outer(num_blocks=1, num_heads=1, temporal_positions="rotary"),
    "catformer": Catformer(num_heads=1),
    "coberl": CoBERL(),
    "gtrxl": GTrXL(num_heads=1),
    "gru": GRU(hidden_dim=4),
}


@pytest.mark.parametrize("history", HISTORIES.values(), ids=HISTORIES)
def test_tokens_that_are_passed_on_are_those_of_the_window(history):
    frame = Inner(embed_dim=4, num_heads=1, num_blocks=2)
    if isinstance(history, CoBERL):
        frame = Inner(embed_dim=32, num_heads=1, num_blocks=2)
    policy, task = make_policy(frame=frame, history=history)
    assert difference(policy, task, step_by_step=True) < 1e-5


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("step_by_step", [False, True])
def test_what_precedes_an_episode_and_what_is_hidden(padding, step_by_step):
    policy, task = make_policy(padding=padding, hide_velocities=True)
    program = program_of(policy, task, step_by_step=step_by_step)
    name = "observation" if step_by_step else "history"
    assert program.inputs[name].shape[-1] == 4  # the task's own, with velocities
    assert difference(policy, task, step_by_step=step_by_step) < 1e-5


@pytest.mark.parametrize(
    "history", [LSTM(hidden_dim=4), GRU(hidden_dim=4), MinGRU(), GatedDeltaNet(), Mamba2()]
)
def test_recurrent_states(history):
    policy, task = make_policy(history=history, num_frames=1)
    assert program_of(policy, task).state[0] == "recurrent_state_h"
    assert difference(policy, task) < 1e-5


def test_training_goes_on_after_an_export(tmp_path):
    policy, task = make_policy(history=Outer(num_blocks=1, num_heads=1, ffn_dropout=0.5))
    policy[1].train()
    modes = [part.training for part in policy.modules()]
    assert len(set(modes)) == 2
    assert export_policy(policy, task, tmp_path / "policy.pt2")["difference"] < 1e-5
    assert [part.training for part in policy.modules()] == modes


def test_two_trunks_leave_the_value_out():
    task = lambda copies: make_env("CartPole-v1", copies, num_frames=3)  # noqa: E731
    backbone = Backbone(MLP((4,), 3), out_keys=["policy_features", "value_features"])
    head = TensorDictModule(nn.Linear(64, 1), ["value_features"], ["state_value"])
    actor = make_actor(64, task(1).action_spec_unbatched, in_key="policy_features")
    policy = TensorDictSequential(backbone, actor, head)
    program = program_of(policy, task)
    own = sum(x.numel() for x in program.parameters())
    assert own == sum(
        x.numel() for x in [*backbone.module.policy.parameters(), *actor.parameters()]
    )
    assert difference(policy, task) < 1e-5


@pytest.mark.parametrize(
    ("action", "masked"),
    [
        ("Discrete", True),
        ("MultiDiscrete", False),
        ("MultiDiscrete", True),
        ("MultiBinary", False),
        ("Box", False),
    ],
)
def test_every_kind_of_action_and_of_observation(action, masked):
    frame = Linear(embed_dim=4)
    policy, task = make_policy(f"{action}Actions-v0", frame, mask_actions=masked)
    program = program_of(policy, task, step_by_step=True, sample=True)
    assert ("action_mask" in program.inputs) == masked
    kinds = [program.inputs[f"observation_{name}"] for name in ("image", "state_0", "state_1")]
    assert kinds == [
        Entry((3, 12, 12), torch.uint8),
        Entry((3,), torch.float32),
        Entry((1,), torch.int64),
    ]
    given = program.examples(5)
    given["noise"] = torch.randn_like(given["noise"]) * 3
    with torch.no_grad():
        actions = program(given)["action"]
    assert all(tasks.ACTIONS[action].contains(x.numpy()) for x in actions)  # as the task takes it
    assert difference(policy, task, step_by_step=True, sample=True) < 1e-5


@pytest.mark.parametrize("step_by_step", [False, True])
def test_values_of_forbidden_actions_do_not_count(step_by_step, tmp_path):
    """TorchRL writes the lowest number for them, once the action is chosen."""
    recipe = DQN(env="Taxi-v4", backbone=tit(2), mask_actions=True, evaluation_episodes=1)
    agent = load_agent(make_run(tmp_path / "run", recipe))
    assert difference(agent.policy, agent.make_env, step_by_step=step_by_step) < 1e-5


def test_samples_follow_the_distribution():
    policy, task = make_policy("MultiDiscreteActions-v0")
    program = program_of(policy, task, sample=True)
    assert program.noise == "gumbel"
    given = {name: x.expand(20_000, *x.shape[1:]) for name, x in program.examples(1).items()}
    uniform = torch.rand(given["noise"].shape, dtype=torch.float64)
    outputs = program({**given, "noise": (-(-uniform.log()).log()).float()})
    for entry, logits in enumerate(outputs["logits"][0]):
        drawn = torch.bincount(outputs["action"][:, entry], minlength=len(logits)) / 20_000
        # Five standard deviations of what is counted.
        assert ((drawn - logits.softmax(-1)).abs() < 2.5 / 20_000**0.5).all()
    quiet = program({**given, "noise": torch.zeros_like(given["noise"])})
    assert torch.equal(quiet["action"], program_of(policy, task)(given)["action"])


def test_a_gaussian_is_its_mean_and_standard_deviation_times_noise():
    policy, task = make_policy("Pendulum-v1")
    program = program_of(policy, task, sample=True)
    assert program.noise == "standard_normal"
    noise = torch.tensor([[0.5], [100.0]])
    outputs = program({**program.examples(2), "noise": noise})
    assert_near(outputs["action"][0], (outputs["loc"] + outputs["scale"] * noise)[0])
    assert outputs["action"][1] == 2  # clipped as on the way to the task


@pytest.mark.parametrize(
    ("name", "output", "factor", "by"),
    [
        ("CartPole-v1", "logits", 1 + 1e-4, r"\d\.\de-0"),
        ("Pendulum-v1", "action", torch.nan, "inf"),
    ],
)
def test_a_policy_that_differs_is_noticed(name, output, factor, by):
    policy, task = make_policy(name)
    program = program_of(policy, task)

    def run(inputs):
        outputs = program(inputs)
        return {**outputs, output: outputs[output] * factor}

    with pytest.raises(NotTheSameError, match=f"differs from the live one by {by}"):
        compare(run, program, policy, task(COPIES))


def test_a_state_that_is_not_passed_on_is_noticed():
    policy, task = make_policy()
    program = program_of(policy, task, step_by_step=True)

    def forgetful(inputs):
        return program({**inputs, "tokens": torch.zeros_like(inputs["tokens"])})

    with pytest.raises(NotTheSameError):
        compare(forgetful, program, policy, task(COPIES))


def test_actions_are_the_most_likely_whatever_the_exploration_type():
    policy, task = make_policy()
    program = program_of(policy, task)
    given = program.examples(50)
    with set_interaction_type(InteractionType.RANDOM):
        assert len(program(given)["action"].unique()) == 1


def test_policies_of_other_kinds_are_refused():
    policy, task = make_policy()
    env = task(1)
    linear = TensorDictModule(nn.Linear(4, 2), ["observation"], ["action"])
    with pytest.raises(ValueError, match="the policy begins with TensorDictModule, but only one"):
        read_parts(TensorDictSequential(linear), env)
    other = Backbone(nn.Sequential(nn.Flatten(-2), nn.Linear(12, 4)))
    with pytest.raises(ValueError, match="the backbone is around a Sequential"):
        read_parts(TensorDictSequential(other, *list(policy.module)[1:]), env)
    with pytest.raises(ValueError, match="writes no 'action' behind its backbone"):
        read_parts(TensorDictSequential(policy.module[0], policy.module[-1]), env)
    with pytest.raises(ValueError, match="no History of the environment writes 'history'"):
        read_parts(policy, env.base_env)


def test_there_is_nothing_to_draw_from_values():
    policy, task = make_policy()
    backbone = policy.module[0]
    values = TensorDictModule(nn.Linear(backbone.features_dim, 2), ["features"], ["action"])
    with pytest.raises(ValueError, match="no distribution to draw actions from"):
        program_of(TensorDictSequential(backbone, values), task, sample=True)
