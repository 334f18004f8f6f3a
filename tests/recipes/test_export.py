"""What every algorithm trains can be exported."""

from functools import partial
from typing import Any

import pytest

from recipes.algorithm import make_algorithm
from recipes.dqn import DQN
from recipes.sac import SAC
from tests.export.policies import shake
from tests.recipes.cql.cql_runs import make_cartpole_data, make_cql, tit
from tests.recipes.decision_transformer.sequence_runs import SMALL, make_dt, make_odt
from tests.recipes.offline.offline_runs import IQL, TD3BC, make
from torchrl_tit.export.comparison import COPIES, compare
from torchrl_tit.export.policy import make_program
from torchrl_tit.export.program import read_parts
from torchrl_tit.settings.networks import decision_transformer

SHORT: dict[str, Any] = {"backbone": tit(3), "name": "small"}


def discrete_dt(folder):
    return make_dt(
        folder,
        dataset=str(make_cartpole_data(folder)),
        env="CartPole-v1",
        target_returns=(20.0,),
        backbone=decision_transformer(**SMALL),
        action_space="discrete",
    )


# Step by step, the rest follows from what is carried; see tests/export for the other form.
RECIPES = {
    "sac": (lambda folder: SAC(env="Pendulum-v1", **SHORT), "standard_normal", False),
    "cql": (partial(make_cql, backbone=tit(3)), "standard_normal", False),
    "iql": (
        partial(make, IQL, backbone=tit(3), normalize_observations=True),
        "standard_normal",
        True,
    ),
    "td3bc": (partial(make, TD3BC, backbone=tit(3), normalize_observations=True), None, False),
    "dqn": (lambda folder: DQN(env="CartPole-v1", **SHORT), None, False),
    "dt": (make_dt, None, True),
    "dt, windows": (make_dt, None, False),
    "dt, discrete": (discrete_dt, "gumbel", True),
    "odt": (make_odt, "standard_normal", True),
}


@pytest.mark.parametrize(("recipe", "noise", "step_by_step"), RECIPES.values(), ids=RECIPES)
def test_the_agents_of_every_algorithm(recipe, noise, step_by_step, tmp_path):
    algorithm = make_algorithm(recipe(tmp_path))
    policy = algorithm.policy.eval()
    shake(policy)
    normalization = getattr(algorithm, "statistics", getattr(algorithm, "agent", None))
    for buffer in normalization.buffers() if normalization is not None else ():
        buffer.uniform_(0.5, 2)  # mean and standard deviation
    env = algorithm.make_env(COPIES)
    parts = read_parts(policy, env)
    program = make_program(parts, step_by_step=step_by_step, sample=noise is not None)
    assert program.noise == noise
    # In ONNX, inputs and outputs share their names.
    assert not {*program.inputs} & {*program(program.examples(1))}
    assert compare(program, program, policy, env, observations=60) < 1e-5
    env.close()
