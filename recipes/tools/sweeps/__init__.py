"""Many runs: sweeps over recipes and seeds on this machine or a cluster, and searches."""
