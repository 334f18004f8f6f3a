"""Many runs: recipes and seeds in worker processes on this machine or a cluster, and searches."""
