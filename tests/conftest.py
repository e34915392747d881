import os

import torch
from hypothesis import settings

# A worker per core: torch's own threads would only get in each other's way.
torch.set_num_threads(int(os.environ.get("NPDR_NUM_THREADS", "1")))

# The same examples every time, so that a run says something about the change under test;
# NPDR_EXPLORE=1 looks for new ones.
settings.register_profile("repeatable", derandomize=True)
settings.register_profile("explore", max_examples=2_000)
settings.load_profile("explore" if os.environ.get("NPDR_EXPLORE") else "repeatable")
