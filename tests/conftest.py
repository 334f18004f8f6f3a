"""Settings of the whole suite."""

import torch

# Small networks gain nothing from threads, and parallel test workers would fight over the cores.
torch.set_num_threads(1)
