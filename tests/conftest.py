"""One thread in each test process and in those it starts: more would fight for the cores."""

import os

# programs that need what only `make mutate` installs
collect_ignore = ["mutation/__main__.py", "mutation/changes.py"]

os.environ["OMP_NUM_THREADS"] = "1"  # before PyTorch is imported
