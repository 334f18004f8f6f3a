"""What the recipes of conservative Q-learning share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase

from torchrl_tit.datasets import Episodes, HistoryStorage, load_episodes, make_replay_buffer
from torchrl_tit.datasets.histories import TerminalObservations, TimeLimits, Unfinished
from torchrl_tit.transforms.history import Padding

from ..compilation import Compile, compile_options, should_compile
from ..offline.outcomes import Outcome
from ..offline.recipe import OfflineRecipe, is_remote
from ..offline.state import TrainingState
from ..offline.training import Training, run_updates
from ..recipe import check_at_least, check_at_most
from ..run import Run
from .agent import QAgent

AgentT = TypeVar("AgentT", bound=QAgent)


class Update(Protocol):
    """One gradient step."""

    TERMS: ClassVar[list[str]]
    """What it gives."""

    def __call__(self, batch: TensorDictBase, step: int, saved_step: int) -> Tensor:
        """Takes it on a batch; ``step`` and ``saved_step`` are for messages."""


@dataclass(frozen=True, kw_only=True)
class CQLRecipe(OfflineRecipe[AgentT]):
    """Settings of every recipe that learns Q values from a data set."""

    continuous: ClassVar[bool]
    """Whether actions are continuous."""

    compiling_pays_on: ClassVar[tuple[str, ...]] = ("cuda",)
    """Types of device on which "auto" compiles."""

    history: int = 1
    """Number K of observations that the backbone sees."""
    padding: Padding = "same"
    """What stands before an episode's first observation: that observation, or zeros."""
    total_updates: int = 500_000
    """Gradient steps to train for."""
    batch_size: int = 256
    """Transitions in one gradient step, drawn with replacement."""
    gamma: float = 0.99
    """Discount factor."""
    tau: float = 0.005
    """Share of the weights that the target networks take over at each gradient step."""
    conservative_weight: float = 5.0
    """Weight of the conservative term."""
    adam_eps: float = 1e-8
    """Epsilon of Adam."""
    time_limits: TimeLimits = "drop"
    """Whether the last transition of an episode that a time limit cut off is kept. d3rlpy 1.1.1,
    which the paper used, dropped it."""
    terminal_observations: TerminalObservations = "zero"
    """Whether a terminal observation is kept or zeroed, as in d3rlpy 1.1.1; nothing reads it."""
    unfinished: Unfinished = "drop"
    """Whether an episode without an end, with which the data break off, is kept."""
    evaluation_interval: int = 1000
    """Gradient steps between evaluations."""
    evaluation_episodes: int = 10
    """Episodes of every evaluation, side by side."""
    compile: Compile = "auto"
    """Whether the losses run through torch.compile, which needs a C++ compiler and about a minute
    at the start: "auto" is on where it pays, in runs long enough to earn that back. Continuous CQL
    compiles the policy alone on a CPU, since critics are matrix products, which compiling does not
    make faster; discrete CQL is compiled on a GPU only."""
    cuda_graphs: Compile = "auto"
    """Whether a GPU launches what is compiled as CUDA graphs; "auto" is on."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(
            self,
            history=1,
            total_updates=1,
            gamma=0,
            tau=0,
            conservative_weight=0,
            adam_eps=0,
            evaluation_interval=1,
        )
        check_at_most(self, gamma=1, tau=1)

    @property
    def final_step(self) -> int:
        """Gradient steps of the whole run."""
        return self.total_updates

    def evaluation_due(self, step: int) -> bool:
        """Whether the agent is evaluated after so many gradient steps."""
        return step % self.evaluation_interval == 0 or step == self.total_updates

    def compile_options(self) -> dict[str, Any] | None:
        """How torch.compile is called; None where it is not.

        Raises:
            ValueError: if it is asked for where it cannot be.
        """
        device = self.torch_device()
        options = compile_options(self.cuda_graphs, device)
        pays = self.compile == "on" or device.type in self.compiling_pays_on
        return options if pays and should_compile(self.compile, self.total_updates) else None

    def load_player(self, run: Run, **settings: Any) -> tuple[TensorDictModuleBase, EnvBase]:
        """As :meth:`Recipe.load_player`."""
        _, agent, _ = self.load_agent(run)
        agent.eval()
        return agent.policy, agent.make_env(1, **settings)

    def play(self, agent: AgentT, step: int) -> list[Outcome]:
        """Plays the evaluation's episodes."""
        returns = agent.play(self.evaluation_episodes, self.evaluation_seed)
        return [Outcome(step, returns.tolist())]

    def check(self) -> None:
        """Builds the agent, lets it act once, and reads the data where they are here already.

        Raises:
            ValueError: if they cannot be built as the fields say, or do not fit each other.
        """
        self.compile_options()
        agent = self.make_agent()
        env = agent.make_env(1)
        with torch.no_grad():
            agent.policy(env.reset())
        env.close()
        if not is_remote(self.dataset):
            self.make_buffer()

    def make_update(self, agent: AgentT) -> tuple[Update, Mapping[str, torch.optim.Optimizer]]:
        """Builds the gradient step of an agent, and its optimizers by name."""
        raise NotImplementedError

    def train(self, run: Run) -> None:
        """Trains an agent, from the newest checkpoint of the run where there is one.

        Args:
            run: an open run folder.

        Raises:
            FloatingPointError: if a loss is not finite.
        """
        torch.set_num_threads(self.threads)
        torch.manual_seed(self.seed)
        buffer = self.make_buffer()
        agent = self.make_agent()
        update, optimizers = self.make_update(agent)
        parts = {"agent": agent, **optimizers, "buffer": buffer}
        state = TrainingState(parts, self.evaluation_seed)

        def step(number: int) -> Tensor:
            return update(buffer.sample(), number, state.saved_step)

        run_updates([Training(self, run, agent, state)], update.TERMS, step)

    def load_data(self) -> Episodes:
        """Loads the data set.

        Raises:
            FileNotFoundError: if there are no such data.
            DatasetError: if they cannot be used, or are not of the task.
            ValueError: if their actions are of the other kind.
        """
        episodes = load_episodes(self.dataset, **self.reading())
        if episodes.rows["action"].is_floating_point() != self.continuous:
            found, expected = ("integers", "floats") if self.continuous else ("floats", "integers")
            raise ValueError(
                f"the actions in {self.dataset} are {found}, but those of {self.env} are "
                f"{expected}: take other data"
            )
        return episodes.to(self.torch_device())

    def make_buffer(self, episodes: Episodes | None = None) -> ReplayBuffer:
        """Makes a replay buffer of transitions with histories.

        Args:
            episodes: of :meth:`load_data`; loaded where not given.
        """
        storage = HistoryStorage(
            self.load_data() if episodes is None else episodes,
            self.history,
            padding=self.padding,
            time_limits=self.time_limits,
            terminal_observations=self.terminal_observations,
            unfinished=self.unfinished,
        )
        return make_replay_buffer(storage, self.batch_size, seed=self.seed)
