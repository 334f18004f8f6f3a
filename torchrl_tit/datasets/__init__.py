"""Data sets for offline RL: from D4RL, Minari, HDF5 files and arrays to TorchRL replay buffers."""

from torchrl_tit.datasets.checks import DatasetError, TaskSpaces, task_spaces
from torchrl_tit.datasets.episodes import Episodes, join_episodes, select_episodes, split_episodes
from torchrl_tit.datasets.hdf5 import read_hdf5, write_hdf5
from torchrl_tit.datasets.minari import read_minari, write_minari
from torchrl_tit.datasets.online import OnlineHistoryStorage
from torchrl_tit.datasets.replay_buffer import ConsecutiveSampler, make_replay_buffer, make_sampler
from torchrl_tit.datasets.sources import download_d4rl, load_episodes
from torchrl_tit.datasets.storages import EpisodeStorage, HistoryStorage, SequenceStorage
from torchrl_tit.datasets.transition_parts import TransitionParts
from torchrl_tit.datasets.transitions import episodes_from_arrays
from torchrl_tit.scores import REFERENCE_RETURNS, has_reference, normalized_score, normalized_spread

__all__ = [
    "REFERENCE_RETURNS",
    "ConsecutiveSampler",
    "DatasetError",
    "EpisodeStorage",
    "Episodes",
    "HistoryStorage",
    "OnlineHistoryStorage",
    "SequenceStorage",
    "TaskSpaces",
    "TransitionParts",
    "download_d4rl",
    "episodes_from_arrays",
    "has_reference",
    "join_episodes",
    "load_episodes",
    "make_replay_buffer",
    "make_sampler",
    "normalized_score",
    "normalized_spread",
    "read_hdf5",
    "read_minari",
    "select_episodes",
    "split_episodes",
    "task_spaces",
    "write_hdf5",
    "write_minari",
]
