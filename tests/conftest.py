"""One thread in each test process and in those it starts: more would fight for the cores."""

import os

os.environ["OMP_NUM_THREADS"] = "1"  # before PyTorch is imported
