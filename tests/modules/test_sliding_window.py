"""The last entries of a sequence."""

import torch

from torchrl_tit.modules.sliding_window import SlidingWindow


def test_holds_the_last_entries_however_many_came():
    stream = torch.randn(3, 40, 2, 5)
    for count in (1, 2, 7):
        window = SlidingWindow(stream[:, :count])
        for step in range(count, 40):
            window.append(stream[:, step])
            assert torch.equal(window.entries, stream[:, step + 1 - count : step + 1])


def test_keeps_copies():
    entries, entry = torch.zeros(2, 3), torch.ones(2)
    window = SlidingWindow(entries)
    window.append(entry)
    entries.fill_(7)
    entry.fill_(7)
    assert window.entries.tolist() == [[0, 0, 1], [0, 0, 1]]
