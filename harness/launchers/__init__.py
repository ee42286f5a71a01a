"""Ways to run a list of runs."""
