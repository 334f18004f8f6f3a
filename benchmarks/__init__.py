"""Speed compared with peers, as ratios measured in one run."""
