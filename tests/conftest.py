import os

# One thread: the tensors here are small, and other processes may share the machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import hypothesis
import pytest

# The same examples on every run; no deadline, since nothing here is about time.
hypothesis.settings.register_profile("visadapt", derandomize=True, deadline=None, print_blob=True)
hypothesis.settings.load_profile("visadapt")

# torch and the library are imported where they are needed: the process that hands the tests to others needs neither.


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    import torch

    torch.set_num_threads(1)


@pytest.fixture
def only_effects():
    """Leaves the effects of these names and the camera's in the catalogue: the fewer, the shorter is a search."""
    from visadapt.effects import EFFECTS
    from visadapt.effects.base import Stage

    whole = dict(EFFECTS)

    def keep(*names: str) -> None:
        for name in [n for n, effect in EFFECTS.items() if n not in names and effect.stage is not Stage.CAMERA]:
            del EFFECTS[name]

    yield keep
    # In their order, by which effects that no data tell apart are listed.
    EFFECTS.clear()
    EFFECTS.update(whole)
