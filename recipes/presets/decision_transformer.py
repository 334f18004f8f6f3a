"""The paper's runs of Decision Transformer and DT_TIT, and Online Decision Transformer, as data."""

from __future__ import annotations

from torchrl_tit.settings.networks import decision_transformer, dt_tit

from .preset import DT, ODT, Preset, of_networks

# Task name: environment and target returns (arXiv 2106.01345, appendix). D4RL's data are from v2 of
# the tasks; v4 is closer to it than v5.
_TASKS = {
    "halfcheetah": ("HalfCheetah-v4", (12000.0, 6000.0)),
    "hopper": ("Hopper-v4", (3600.0, 1800.0)),
    "walker2d": ("Walker2d-v4", (5000.0, 2500.0)),
}


def _offline() -> list[Preset]:
    networks = {
        "dt": decision_transformer(),
        "dt-tit": dt_tit(),
        "dt-tit-paper": dt_tit(position_encoding=True),  # which the authors' code leaves out
    }
    return [
        recipe
        for task, (env, target_returns) in _TASKS.items()
        for data in (f"{task}-medium-v2", f"{task}-medium-replay-v2")
        for recipe in of_networks(
            DT, f"dt/{data}", networks, dataset=data, env=env, target_returns=target_returns
        )
    ]


def _online() -> list[Preset]:
    recipes = []
    for dataset in ("hopper-medium-v2", "hopper-medium-replay-v2"):
        for network, make_network in (("odt", decision_transformer), ("odt-tit", dt_tit)):
            recipe = ODT(
                name=f"odt/{dataset}/{network}",
                dataset=dataset,
                env="Hopper-v4",
                target_returns=(3600.0,),
                online_return=7200.0,
                backbone=make_network(
                    embed_dim=512, num_blocks=4, num_heads=4, timestep_embedding=False
                ),
            )
            recipes += [
                recipe,
                # Small runs, which a CPU finishes in minutes: a smaller network that learns faster,
                # has target returns that occur in the data, and reads as many frames when it acts
                # as in training.
                recipe.replace(
                    name=f"odt/{dataset}/{network}-small",
                    target_returns=(3000.0,),
                    online_return=3200.0,
                    backbone=make_network(
                        embed_dim=64, num_blocks=2, num_heads=2, timestep_embedding=False
                    ),
                    acting_num_frames=None,
                    batch_size=64,
                    learning_rate=1e-3,
                    warmup_updates=100,
                    pretraining_updates=500,
                    rounds=60,
                    updates_per_round=30,
                    evaluation_episodes=20,
                    log_interval=30,
                ),
            ]
    return recipes


RECIPES: list[Preset] = [*_offline(), *_online()]
"""``dt/DATASET/dt``, ``dt-tit``, ``dt-tit-paper`` for D4RL's sets of version 2, and ``odt/...``."""
