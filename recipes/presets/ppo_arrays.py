"""The named recipes of classic control and MuJoCo (arXiv 2212.14538, table 2).

All networks train with one set of settings, but for the MLP's learning rate. Recipes whose names
end in "-protocol" use the settings of the paper and its release instead; where the two contradict
each other, "-paper" has the paper's.
"""

from __future__ import annotations

from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import d2rl, enhanced_tit, lstm, mlp, ofenet, vanilla_tit

from .ppo_settings import reliable_tit, settings_of
from .preset import PPO, Preset

# Task name: environment and steps (arXiv 2212.14538, appendix). The paper ran MuJoCo's v3.
_TASKS = {
    "acrobot": ("Acrobot-v1", 100_000),
    "cartpole": ("CartPole-v1", 100_000),
    "mountaincar": ("MountainCar-v0", 100_000),
    "ant": ("Ant-v5", 1_000_000),
    "halfcheetah": ("HalfCheetah-v5", 1_000_000),
    "hopper": ("Hopper-v5", 1_000_000),
    "walker2d": ("Walker2d-v5", 1_000_000),
}
_BASELINES: dict[str, Network] = {"mlp": mlp(), "ofenet": ofenet(), "d2rl": d2rl()}
_NETWORKS: dict[str, Network] = {
    **_BASELINES,
    "lstm": lstm(),
    "vanilla-tit": reliable_tit("vanilla-tit"),
    "enhanced-tit": reliable_tit("enhanced-tit"),
}
# The paper does not say which settings of TIT were used for which task, within patch 1, width 32 or
# 64, two blocks; these are the networks' defaults.
_PROTOCOL: dict[str, Network] = {
    **_BASELINES,
    "vanilla-tit": vanilla_tit(),
    "enhanced-tit": enhanced_tit(),
}
# The authors published these for this task only. They are not in the paper's ranges.
_MOUNTAINCAR_PROTOCOL: dict[str, Network] = {
    "vanilla-tit": vanilla_tit(embed_dim=32, num_heads_inner=4, num_heads_outer=8, features_dim=64),
    "enhanced-tit": enhanced_tit(
        embed_dim=16, num_heads_inner=4, num_heads_outer=8, features_dim=128
    ),
}


def _named() -> list[Preset]:
    recipes = []
    for task, (env, total_steps) in _TASKS.items():
        published = _MOUNTAINCAR_PROTOCOL if task == "mountaincar" else {}
        for network, backbone in _NETWORKS.items():
            name = f"ppo/{task}/{network}"
            recipe = PPO(name=name, env=env, total_steps=total_steps, backbone=backbone)
            recipes.append(recipe.replace(**settings_of(network)))
            if network in _PROTOCOL:
                backbone = (_PROTOCOL | published)[network]
                recipes.append(recipe.replace(name=f"{name}-protocol", backbone=backbone))
            if network in published:
                recipes.append(recipe.replace(name=f"{name}-paper", backbone=_PROTOCOL[network]))
    return recipes


RECIPES: list[Preset] = _named()
