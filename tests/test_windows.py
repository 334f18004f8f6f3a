"""Windows hold the frames that a plain walk backwards finds."""

import numpy as np
import pytest
import torch

from torchrl_tit.windows import Windows, find_windows


def by_walking(frames, newest, oldest, num_frames, padding):
    """The window of one step: from the newest frame backwards, then padding."""
    window: list[torch.Tensor] = []
    row = newest
    while len(window) < num_frames:
        if row >= oldest:
            window.append(frames[row])
        else:
            window.append(frames[oldest] if padding == "same" else torch.zeros_like(frames[0]))
        row -= 1
    return torch.stack(window[::-1])


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("num_frames", [1, 2, 5])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32, torch.int64, torch.bool])
def test_windows_of_rows(num_frames, padding, dtype):
    torch.manual_seed(0)
    frames = torch.randint(1, 250, (40, 2, 3)).to(dtype)
    oldest = torch.randint(0, 10, (4, 6))
    newest = oldest + torch.randint(0, 30, (4, 6))
    windows = find_windows(newest, oldest, num_frames, padding)
    gathered = windows.gather(frames)
    assert (gathered.shape, gathered.dtype) == ((4, 6, num_frames, 2, 3), dtype)
    for step in np.ndindex(4, 6):
        rows = newest[step].item(), oldest[step].item()
        expected = by_walking(frames, *rows, num_frames, padding)
        assert torch.equal(gathered[step], expected)


def test_gathering_copies():
    frames = torch.zeros(3, 2)
    Windows(torch.tensor([0, 1]), None).gather(frames).fill_(1)
    assert not frames.any()
