"""Settings for all tests."""

import os

# With `-n 2` every worker has a core of its own; more threads than cores wait for each other. Set
# before PyTorch is imported, and inherited by the commands that tests start.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
