import os

# One thread: the tensors here are small, and other processes may share the machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import hypothesis
import torch

torch.set_num_threads(1)
# The same examples on every run; no deadline, since nothing here is about time.
hypothesis.settings.register_profile("visadapt", derandomize=True, deadline=None, print_blob=True)
hypothesis.settings.load_profile("visadapt")
