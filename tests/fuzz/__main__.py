"""Fuzzes the readers of files: `python -m tests.fuzz --minutes 10`, or a kept input again: `... tests/crashes/FILE`.

An input is damaged in ways that its seed and its number determine. One that is neither read nor refused in one line is
kept in tests/crashes, where tests/fuzz/test_fuzz.py finds it.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

from tests.fuzz.inputs import again, counted, kept
from tests.fuzz.readers import READERS

BATCH = 200  # Inputs that one process tries


def main() -> int:
    """0 where no input fails."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("again", nargs="*", type=Path, metavar="tests/crashes/FILE", help="try these kept inputs alone")
    parser.add_argument("--minutes", type=float, default=10.0, help="shared evenly by the readers (default: 10)")
    parser.add_argument("--seed", type=int, default=0, help="of the damage (default: 0)")
    parser.add_argument("--readers", nargs="+", choices=READERS, default=list(READERS), metavar="NAME")
    options = parser.parse_args()
    for path in options.again:
        print(f"{path}: {again(path).answer}")
    if options.again:
        return int(any(again(path).failed for path in options.again))
    print(f"seed {options.seed}, {options.minutes:g} min, readers: {', '.join(options.readers)}", flush=True)
    spent, counts = dict.fromkeys(options.readers, 0.0), {name: Counter[str]() for name in options.readers}
    while min(spent.values()) < 60 * options.minutes / len(spent):
        name = min(spent, key=lambda name: spent[name])
        began, first = time.monotonic(), counts[name].total()
        found, failed = counted(name, options.seed, range(first, first + BATCH))
        counts[name] += found
        spent[name] += time.monotonic() - began
        for one in failed:
            path = kept(name, options.seed, one)
            print(f"{one.answer[:300]}\n  again: python -m tests.fuzz {path.relative_to(Path.cwd())}", flush=True)
    for name, count in counts.items():
        print(f"{name}: {count.total():,} inputs, {count['refused']:,} refused, {count['read']:,} read, "
              f"{count['failed']:,} failed; {spent[name] / count.total() * 1e3:.1f} ms each")  # fmt: skip
    return int(any(count["failed"] for count in counts.values()))


if __name__ == "__main__":
    sys.exit(main())
