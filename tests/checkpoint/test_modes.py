"""Who may read a checkpoint, and what a foreign state may set."""

from typing import Any

import gymnasium as gym
import pytest
import torch

from torchrl_tit.checkpoint import save_checkpoint
from torchrl_tit.checkpoint.gymnasium_state import layer_state, layers, set_layer_state


def test_both_files_are_read_by_the_same_people(tmp_path):
    folder = save_checkpoint(tmp_path, 1, {"weight": torch.ones(2)})
    modes = {path.stat().st_mode & 0o777 for path in folder.iterdir()}
    (tmp_path / "other").touch()  # with the mode that this process gives to files
    assert modes == {(tmp_path / "other").stat().st_mode & 0o777}


def test_only_what_changes_in_a_task_is_set():
    core: Any = [*layers(gym.make("CartPole-v1"))][-1]
    state = layer_state(core)
    state["attributes"]["gravity"] = 0.0
    with pytest.raises(ValueError, match=r"has the attributes \['gravity', 'state', 'steps_beyond"):
        set_layer_state(core, state)
    assert core.gravity == 9.8
    del state["attributes"]["gravity"], state["attributes"]["state"]
    with pytest.raises(ValueError, match="but those that change are"):
        set_layer_state(core, state)
