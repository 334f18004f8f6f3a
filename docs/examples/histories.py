"""Two recipes: TIT on CartPole without velocities, which reads one frame or eight (`make demo`)."""

from dataclasses import replace

from torchrl_tit.recipes import get_recipe

RECIPES = {
    f"k{frames}": replace(
        get_recipe(f"ppo/cartpole-no-velocity/enhanced-tit-k{frames}"), total_steps=60_000
    )
    for frames in (1, 8)
}
