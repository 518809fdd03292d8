"""`python -m benchmarks.baselines`: see `benchmarks.baselines.table`."""

import tyro

from benchmarks.baselines.table import Settings, __doc__ as description, main

if __name__ == "__main__":
    main(tyro.cli(Settings, description=description))
