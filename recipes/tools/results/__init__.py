"""Results of finished runs: the paper's tables, learning curves, films."""
