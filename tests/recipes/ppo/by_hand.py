"""What PPO computes, written as loops over steps."""

import torch


def numbers_of(minibatch, rollout):
    """The numbers of a minibatch's steps in the batch, [N, T], found by their newest frame."""
    newest = minibatch.windows.gather(minibatch.frames[0])[..., -1, :].unsqueeze(-2)
    same = (newest == rollout.frames[0][rollout.newest]).all(-1)  # [N, T, steps]
    assert (same.sum(-1) == 1).all()
    return same.int().argmax(-1)


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
