"""Acts with a policy of `export AGENT --step-by-step --out FILE.onnx`, without torch.

As a program it plays an episode in Gymnasium; copy the class to act on what a machine sends.
"""

import json
import sys

import numpy as np
import onnxruntime


class Agent:
    """Keeps histories, states and missing values inside, as `torchrl_tit.load_agent` does."""

    def __init__(self, file: str, seed: int = 0) -> None:
        self.policy = onnxruntime.InferenceSession(file)
        metadata = self.policy.get_modelmeta().custom_metadata_map
        self.facts = json.loads(metadata["torchrl_tit"])
        self.draw = np.random.default_rng(seed)
        self.reset()

    def reset(self, which=None):
        """Begins an episode with the next observation: in all copies, or where bool [N] says so."""
        if which is None:
            self.first, self.state, self.last, self.given = True, {}, None, None
            return
        which = np.asarray(which)
        if which.dtype != bool or (self.last is not None and which.size != len(self.last)):
            raise ValueError(f"which must be bool, one for each copy, not {which}")
        self.first = np.logical_or(self.first, which)

    def act(self, observation, *, reward=0.0, action_mask=True):
        """Maps an observation, or those of N copies, [N, ...], to actions; holds values for NaN."""
        shape = tuple(self.facts["inputs"]["observation"]["shape"])
        unknown = np.full(self.given or shape, np.nan)
        frames = np.array(unknown if observation is None else observation, ndmin=1)  # a copy
        several = frames.ndim > len(shape)
        if frames.shape[several:] != shape:
            raise ValueError(f"expected observations {shape} or N of them, not {frames.shape}")
        as_given, frames = frames.shape, frames.reshape(-1, *shape)
        if self.last is not None and len(frames) != len(self.last):
            raise ValueError(f"{len(frames)} copies act, not {len(self.last)}: call reset() first")
        if (missing := np.isnan(frames)).any():
            if (missing.reshape(len(frames), -1).any(1) & self.first).any():
                raise ValueError("the first observation of an episode is missing or has NaN")
            frames = np.where(missing, self.last, frames)
        if not np.isfinite(np.asarray(reward, float)).all():
            raise ValueError(f"the reward is {reward}, not a finite number")
        kind = self.facts["inputs"]["observation"]["dtype"]
        converted = frames.astype(kind)
        if kind != "float32" and (converted != frames).any():
            raise ValueError(f"expected observations of {kind}; images range from 0 to 255")
        if np.isinf(converted).any():
            raise ValueError(f"the observation is infinite in {kind}")
        self.last, self.given = frames, as_given
        given = {"observation": frames, "is_init": self.first, "reward": reward, **self.state}
        given |= {"action_mask": action_mask, "target_return": self.facts.get("target_return")}
        inputs = {}
        for name, entry in self.facts["inputs"].items():
            size = (len(frames), *entry["shape"])
            if name == "noise":
                given[name] = getattr(self.draw, self.facts["noise"])(size=size)
            value = np.asarray(given.get(name, 0), entry["dtype"])
            inputs[name] = np.ascontiguousarray(np.broadcast_to(value, size))
        outputs = dict(zip(self.facts["outputs"], self.policy.run(None, inputs), strict=True))
        self.state = {name: outputs[f"next_{name}"] for name in self.facts["state"]}
        self.first = False
        return outputs["action"] if several else outputs["action"][0]


if __name__ == "__main__":
    import gymnasium

    agent = Agent(sys.argv[1])
    env = gymnasium.make(**agent.facts["task"])
    observation, info = env.reset(seed=0)
    reward, total, done = 0.0, 0.0, False
    while not done:
        mask = info.get("action_mask", True)
        action = agent.act(observation, reward=reward, action_mask=mask)
        observation, reward, terminated, truncated, info = env.step(action)
        total, done = total + reward, terminated or truncated
    print(f"return {total:g}")
