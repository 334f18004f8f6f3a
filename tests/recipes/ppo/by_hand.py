"""What PPO computes, written as loops over steps."""

import torch


def windows_of(minibatch, padding="same"):
    """The windows [N, K, *obs] of single steps, or [N, T, K, *obs] of sequences.

    Of a sequence's histories only the first is read.
    """
    if minibatch.ndim == 1:
        return minibatch["history"]
    rows = []
    for sequence in minibatch:
        window = sequence["history"][0]
        windows = [window]
        for observation, is_init in zip(
            sequence["observation"][1:], sequence["is_init"][1:], strict=True
        ):
            if is_init:
                first = observation if padding == "same" else torch.zeros_like(observation)
                window = torch.stack([first] * (len(window) - 1) + [observation])
            else:
                window = torch.cat([window[1:], observation.unsqueeze(0)])
            windows.append(window)
        rows.append(torch.stack(windows))
    return torch.stack(rows)


def advantages(reward, value, next_value, done, stops, gamma, lmbda):
    """Generalised advantage estimation (arXiv 1506.02438), [envs, time, 1].

    Args:
        stops: where no value follows: at terminations, and at time limits if they count as such.
    """
    expected = torch.zeros_like(value)
    for i in range(value.shape[0]):
        running = 0.0
        for t in reversed(range(value.shape[1])):
            # A termination has no value after it, a time limit has that of the true next state.
            bootstrapped = 0.0 if stops[i, t, 0] else next_value[i, t, 0]
            delta = reward[i, t, 0] + gamma * bootstrapped - value[i, t, 0]
            running = delta + gamma * lmbda * (0.0 if done[i, t, 0] else running)
            expected[i, t, 0] = running
    return expected
