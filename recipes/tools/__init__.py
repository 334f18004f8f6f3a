"""What is done with recipes and runs: sweeps, searches, data sets, tables, reports, agents."""
