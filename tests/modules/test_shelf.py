"""The last entries of a sequence."""

import torch

from torchrl_tit.modules.shelf import Shelf


def test_holds_the_last_entries_however_many_came():
    stream = torch.randn(3, 40, 2, 5)
    for count in (1, 2, 7):
        shelf = Shelf(stream[:, :count])
        for step in range(count, 40):
            shelf.append(stream[:, step])
            assert torch.equal(shelf.entries, stream[:, step + 1 - count : step + 1])


def test_keeps_copies():
    entries, entry = torch.zeros(2, 3), torch.ones(2)
    shelf = Shelf(entries)
    shelf.append(entry)
    entries.fill_(7)
    entry.fill_(7)
    assert shelf.entries.tolist() == [[0, 0, 1], [0, 0, 1]]
