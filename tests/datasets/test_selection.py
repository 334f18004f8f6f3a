"""Selected and joined episodes keep every row."""

import torch

from tests.datasets.rollouts import Transitions, spans
from torchrl_tit.datasets import (
    HistoryStorage,
    episodes_from_arrays,
    join_episodes,
    select_episodes,
)


def test_selected_episodes_keep_their_rows(arrays: Transitions) -> None:
    episodes = episodes_from_arrays(**arrays)
    index = torch.tensor([5, 0, 0, 2])
    selected = select_episodes(episodes, index)
    for number, source in enumerate(index.tolist()):
        start, stop = spans(arrays)[source]
        first = int(selected.first_rows[number])
        rows = selected.rows[first : first + stop - start + 1]
        assert torch.equal(
            rows["observation"][:-1], torch.from_numpy(arrays["observations"][start:stop])
        )
        last = torch.from_numpy(arrays["next_observations"][stop - 1])
        assert torch.equal(rows["observation"][-1], last)
    assert torch.equal(selected.returns, episodes.returns[index])
    assert torch.equal(selected.terminated, episodes.terminated[index])


def test_joined_episodes_are_both(arrays: Transitions) -> None:
    episodes = episodes_from_arrays(**arrays)
    some = select_episodes(episodes, torch.tensor([1, 4]))
    rest = select_episodes(episodes, torch.tensor([0]))
    joined = join_episodes([some, rest])
    expected = select_episodes(episodes, torch.tensor([1, 4, 0]))
    assert (joined.rows == expected.rows).all()
    items = [HistoryStorage(data, 3).get(slice(None)) for data in (joined, expected)]
    assert (items[0] == items[1]).all()
