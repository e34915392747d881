import os

import torch

# A worker per core: torch's own threads would only get in each other's way.
torch.set_num_threads(int(os.environ.get("NPDR_NUM_THREADS", "1")))
