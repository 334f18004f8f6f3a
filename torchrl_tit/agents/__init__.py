"""Trained agents: a policy with its weights, its task and its evaluation.

An agent is a folder of six files (:mod:`~torchrl_tit.agents.folder`): in this package, anywhere on
the disk, or in a repository of the Hugging Face Hub. Reading one executes nothing.
"""

from torchrl_tit.agents.folder import AgentError
from torchrl_tit.agents.loading import TrainedAgent, agent_names, load_agent

__all__ = ["AgentError", "TrainedAgent", "agent_names", "load_agent"]
