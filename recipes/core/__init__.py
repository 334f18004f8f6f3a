"""What all experiments share: recipes, run folders, the loop, checkpoints, metrics."""
