"""Environments with random observations, and the histories that they must have."""

from collections import deque
from collections.abc import Iterable

import torch
from tensordict import NestedKey, TensorDict
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase


class StreamEnv(EnvBase):
    """Random observations, and episodes of random length in each copy."""

    def __init__(self, batch_size=(), shape=(3,), dtype=torch.float32, seed=0):
        super().__init__(batch_size=torch.Size(batch_size))
        self.generator = torch.Generator().manual_seed(seed)
        self.shape_of_one = (*self.batch_size, *shape)
        self.seen = Unbounded(self.shape_of_one, dtype=dtype)
        self.observation_spec = Composite(observation=self.seen, shape=self.batch_size)
        self.action_spec = Categorical(2, shape=self.batch_size)
        self.reward_spec = Unbounded((*self.batch_size, 1))
        self.done_spec = Categorical(2, shape=(*self.batch_size, 1), dtype=torch.bool)

    def _observe(self) -> TensorDict:
        numbers = torch.randint(0, 256, self.shape_of_one, generator=self.generator)
        return TensorDict({"observation": numbers.to(self.seen.dtype)}, self.batch_size)

    def _reset(self, tensordict=None, **kwargs):
        return self._observe()

    def _step(self, tensordict):
        done = torch.rand(*self.batch_size, 1, generator=self.generator) < 0.3
        return self._observe().update({"reward": done.float(), "done": done})

    def _set_seed(self, seed):
        self.generator.manual_seed(seed)


class ReferenceHistory:
    """The last K observations of one environment, in a deque."""

    def __init__(self, num_frames: int, padding: str):
        self.frames: deque[torch.Tensor] = deque(maxlen=num_frames)
        self.padding = padding

    def start(self, observation: torch.Tensor) -> torch.Tensor:
        pad = observation if self.padding == "same" else torch.zeros_like(observation)
        self.frames.extend([pad] * (self.frames.maxlen or 0))
        return self.push(observation)

    def push(self, observation: torch.Tensor) -> torch.Tensor:
        self.frames.append(observation)
        return torch.stack(list(self.frames))


def assert_histories(
    env: EnvBase,
    num_frames: int,
    padding: str,
    steps: int = 60,
    observation: NestedKey = "observation",
    history: NestedKey = "history",
) -> None:
    """Plays the environment [N] and compares every history; fails if no episode ends on its own."""
    references = [ReferenceHistory(num_frames, padding) for _ in range(env.batch_size.numel())]
    root = env.reset()
    started: Iterable[bool] = [True] * len(references)
    single_resets = 0
    for _ in range(steps):
        for i, (reference, fresh) in enumerate(zip(references, started, strict=True)):
            seen = root[observation][i]
            # Within an episode, the history was checked as "next" of the step before.
            expected = reference.start(seen) if fresh else torch.stack(list(reference.frames))
            torch.testing.assert_close(root[history][i], expected, rtol=0, atol=0)
        step, root = env.step_and_maybe_reset(env.rand_action(root))
        for i, reference in enumerate(references):
            expected = reference.push(step["next", observation][i])
            torch.testing.assert_close(step["next", history][i], expected, rtol=0, atol=0)
        ended = step["next", "done"].flatten()
        single_resets += int(ended.any() and (len(references) == 1 or not ended.all()))
        started = ended.tolist()
    assert single_resets > 0, "No episode ended on its own: the stream shows too little."
