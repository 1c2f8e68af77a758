"""Errors of the solvers against the condition of the matrix, in units of rounding errors:
writes RUN/extremes.md.

Run from the project's root: python pipelines/benchmarks/extremes.py --run runs/extremes
"""

import argparse
import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
os.environ.setdefault("OMP_NUM_THREADS", "1")


def main():
    """Make the table, print it and keep it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, default=Path("runs/extremes"))
    folder = parser.parse_args().run
    from tests.reference.extremes import real_table, table

    text = (
        (
            "What an answer violates of its own equations, over eps |A| (|A| |x| + |y|): below 30 "
            "is as good as arithmetic allows. Worst of two kinds of\n"
            "spectra, single and double precision data, and sizes from 1x1 to 60x17. The gap of l1 "
            "is relative, at lambda over the largest useful one.\n\n"
        )
        + table()
        + "\n\nThe system matrix of seed_spatial, one isolated lenslet, 2704 pixels, 1600 points, "
        + "condition 1e12:\n\n"
        + real_table()
        + "\n"
    )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "extremes.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
