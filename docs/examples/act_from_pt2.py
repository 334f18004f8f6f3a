"""Acts in Gymnasium from a policy of `export AGENT --step-by-step --out FILE.pt2`: torch alone."""

import json
import sys

import gymnasium
import numpy as np
import torch

about = {"torchrl_tit.json": ""}
policy = torch.export.load(sys.argv[1], extra_files=about).module()
facts = json.loads(about["torchrl_tit.json"])
kinds = {name: (entry["shape"], entry["dtype"]) for name, entry in facts["inputs"].items()}
env, draw = gymnasium.make(**facts["task"]), np.random.default_rng(0)
observation, info = env.reset(seed=0)
state = {name: np.zeros((1, *kinds[name][0]), kinds[name][1]) for name in facts["state"]}
first, reward, total, done = True, 0.0, 0.0, False
while not done:
    given = {"observation": observation, "is_init": first, "reward": reward, **info}
    given["target_return"] = facts.get("target_return")
    given["noise"] = facts["noise"] and getattr(draw, facts["noise"])(size=kinds["noise"][0])
    inputs = {x: np.asarray((given | state)[x], kinds[x][1]) for x in kinds}
    inputs = {x: inputs[x].reshape(1, *kinds[x][0]) for x in kinds}
    outputs = policy(**{name: torch.from_numpy(x) for name, x in inputs.items()})
    action = outputs["action"].numpy(force=True)[0]
    state = {name: outputs[f"next_{name}"].numpy(force=True) for name in state}
    observation, reward, terminated, truncated, info = env.step(action)
    first, total, done = False, total + reward, terminated or truncated
print(f"return {total:g}")
