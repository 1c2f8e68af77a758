"""Sparse coding beside other solvers: processor time a signal, and the duality gap that each
reached, recomputed for all alike.

The problem is min |y - D c|^2 + lambda |c|_1 for signals of held-out photographs: D = A Phi with
the matrix of one isolated lenslet of a configuration and a dictionary learnt for it, noise at 60
dB, lambda the best on validation patches. A and y are compressed by A's singular vectors, which
changes nothing but a constant, and the constant atom, which is free of the penalty, is projected
out: every solver gets the same D and Y and starts from them, so Gram matrices count. All run in one
process on one thread, in turns; a time is the median over the turns of the process time. Slow
solvers get the first few signals only. The gap comes from the residual in double precision: (P -
dual) / P with the scaled residual as the dual point. Solvers that are not installed are left out:
`pip install -e '.[bench]'`. A second table has the gaps that ours and the quickest of the others
reach where it is hard.

Writes RUN/sparse.json and RUN/sparse.md. Run from the project's root: python
pipelines/benchmarks/sparse.py --help.
"""

import argparse
import json
import os
import sys
import time
import warnings
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np  # noqa: E402

SNR_DB = 60.0
LAMBDAS = np.logspace(-7, -4.5, 11)
HARD_SIGNALS = 16
PACKAGES = {"SPAMS": "spams-bin", "scikit-learn": "scikit-learn", "interior point": "clarabel"}


# the problem


def problem(config, iterations, count, seed):
    """dict: D (row, atom), Y (row, signal) and the same without noise, lambda, and the
    validation table that chose it.
    """
    from plenocli.files.config.camera_file import load_camera
    from plenocli.files.read.training import read_training, split_by_scene
    from plenocli.forward.accuracy.dial import plan_pif
    from plenocli.forward.propagation.system_matrix import build_pif
    from plenocli.inverse.picture.solvers.least_squares import decompose
    from plenocli.inverse.prior.natural_images import at_scales, draw_patches
    from plenocli.inverse.sparse.dictionary import Learner, Settings

    camera = load_camera(config)
    shape = camera.object.samples_per_lenslet
    matrix = build_pif(
        camera,
        plan_pif(camera, model="fresnel", superpixels=(1, 1), coherent_ring=0, accuracy=1e-5),
    ).A[0, 0]
    training, held = (
        [p for _, p in at_scales(part, shape)] for part in split_by_scene(read_training((), shape))
    )
    points = int(np.prod(shape))
    settings = Settings(
        atoms=points, batch=4 * points, lam=1e-6, delta=1e-3, snr_db=SNR_DB, seed=seed
    )
    learner = Learner(decompose(matrix), shape, training, held, settings, workers=1)
    state = learner.start()
    for k in range(iterations):
        state = learner.step(state)
        print(
            (
                f"learning: iteration {k + 1} of {iterations}, validation "
                f"{state.history[-1].validation_psnr:.2f} dB"
            ),
            flush=True,
        )
    table = learner.validate_path(state.atoms, LAMBDAS)
    lam = max(table, key=lambda row: row[1])[0]
    rng = np.random.default_rng([seed, 99])
    patches = draw_patches(held, shape, count, rng)
    signals, _ = learner.measure(patches, rng)
    effective = learner.seen @ state.atoms
    constant = effective[:, :1] / np.linalg.norm(effective[:, 0])
    effective, signals, clean = (
        x - constant @ (constant.T @ x) for x in (effective[:, 1:], signals, learner.seen @ patches)
    )
    return {
        "D": effective,
        "Y": signals,
        "clean": clean,
        "lambda": lam,
        "validation": [(float(a), float(b), float(c)) for a, b, c in table],
    }


# the solvers: (D, Y, lambda) -> coefficients (atom, signal); libraries get the problem divided by
# lambda, since some of their tolerances are absolute: as it stands scikit-learn's LARS ends
# after eleven atoms


def ours(d, y, lam):
    from plenocli.inverse.sparse.l1.solve import sparse_code

    return sparse_code(d, y, lam, tol=1e-6, workers=1).c


def fista(d, y, lam):
    from tests.reference.fista import fista

    return fista(d, y, lam, iterations=300).c


def interior(d, y, lam):
    from tests.reference.interior_point import interior_point

    return interior_point(d, y, lam).c


def spams_cholesky(d, y, lam):
    import spams

    return (
        lam
        * spams.lasso(
            np.asfortranarray(y / lam),
            D=np.asfortranarray(d),
            lambda1=0.5,
            mode=2,
            cholesky=True,
            numThreads=1,
        ).toarray()
    )


def spams_lars(d, y, lam):
    import spams

    return (
        lam
        * spams.lasso(
            np.asfortranarray(y / lam), D=np.asfortranarray(d), lambda1=0.5, mode=2, numThreads=1
        ).toarray()
    )


def sklearn_lars(d, y, lam):
    from sklearn.decomposition import sparse_encode

    return (
        lam
        * sparse_encode(
            y.T / lam, d.T, algorithm="lasso_lars", alpha=0.5, max_iter=4000, n_jobs=1
        ).T
    )


def sklearn_cd(d, y, lam):
    from sklearn.decomposition import sparse_encode

    return (
        lam
        * sparse_encode(y.T / lam, d.T, algorithm="lasso_cd", alpha=0.5, max_iter=1000, n_jobs=1).T
    )


SOLVERS = {
    "ours": (ours, None),
    "SPAMS lasso, Cholesky": (spams_cholesky, None),
    "SPAMS lasso, LARS": (spams_lars, None),
    "scikit-learn lasso_lars (4000)": (sklearn_lars, 4),
    "scikit-learn lasso_cd (1000)": (sklearn_cd, 8),
    "FISTA (300)": (fista, 64),
    "interior point": (interior, 1),
}
"""Name: (function, how many of the signals it gets; None: all)."""


# measuring


def measure(task, rounds, chosen):
    """Rows of the table, and the packages that are missing."""
    from plenocli.inverse.sparse.l1.certificate import duality_gap

    d, y, lam = task["D"], task["Y"], task["lambda"]
    threshold = np.full(d.shape[1], lam / 2)
    times, codes, missing = {}, {}, []
    ours(d[:, :20], y[:, :2], lam)  # compiled before the clock starts
    for _ in range(rounds):
        for name in chosen:
            if name in missing:
                continue
            solver, most = SOLVERS[name]
            part = y[:, :most]
            try:
                begun = time.process_time()
                codes[name] = solver(d, part, lam)
                times.setdefault(name, []).append((time.process_time() - begun) / part.shape[1])
            except Exception as error:
                if not isinstance(error, ImportError) and "needs Clarabel" not in str(error):
                    raise
                missing.append(name)
    rows = []
    for name, c in codes.items():
        _, gap, _ = duality_gap(d, y[:, : c.shape[1]], np.ascontiguousarray(c.T), threshold)
        rows.append(
            {
                "solver": name,
                "signals": c.shape[1],
                "ms": 1e3 * float(np.median(times[name])),
                "ms_all": [1e3 * t for t in times[name]],
                "gap_median": float(np.median(gap)),
                "gap_95": float(np.percentile(gap, 95)),
                "gap_max": float(gap.max()),
                "nonzeros": float(np.count_nonzero(c, axis=0).mean()),
            }
        )
    return rows, missing


def hard_cases(task):
    """Yields (name, D, Y, lambda) of what solvers stumble over."""
    d, y, clean, lam = (
        task["D"],
        task["Y"][:, :HARD_SIGNALS],
        task["clean"][:, :HARD_SIGNALS],
        task["lambda"],
    )
    most = 2 * np.abs(d.T @ y).max()
    for name, value in (
        ("lambda", lam),
        ("lambda / 100", lam / 100),
        ("lambda / 10,000", lam / 1e4),
        ("0.99 of the largest lambda", 0.99 * most),
        ("10 times the largest", 10 * most),
    ):
        yield name, d, y, value
    yield "without noise", d, clean, lam
    loud = clean + 1000 * (y - clean)
    yield "0 dB, lambda x 1,000,000", d, loud, 1e6 * lam
    yield "0 dB, same lambda", d, loud, lam
    yield "100 atoms twice", np.concatenate([d, d[:, :100]], axis=1), y, lam
    empty_d, empty_y = d.copy(), y.copy()
    empty_d[:, ::50], empty_y[:, ::5] = 0, 0
    yield "empty atoms and signals", empty_d, empty_y, lam
    yield "rank 1", np.outer(d[:, 0], np.linspace(0.5, 1, d.shape[1])), y, lam


def measure_hard(task, chosen):
    """[(name, {solver: (median, largest gap) or None where it failed})] of `hard_cases`; a gap
    that is no number counts as 1.
    """
    from plenocli.inverse.sparse.l1.certificate import duality_gap

    out = []
    for name, d, y, lam in hard_cases(task):
        gaps = {}
        for solver in chosen:
            try:
                c = np.ascontiguousarray(np.nan_to_num(SOLVERS[solver][0](d, y, lam), nan=np.inf).T)
                with np.errstate(all="ignore"):
                    gap = np.nan_to_num(
                        duality_gap(d, y, c, np.full(d.shape[1], lam / 2))[1], nan=1.0
                    )
                gaps[solver] = float(np.median(gap)), float(gap.max())
            except Exception:
                gaps[solver] = None
        out.append((name, gaps))
    return out


def markdown_hard(hard, chosen):
    """The table of `measure_hard`."""
    lines = [
        f"{HARD_SIGNALS} signals, gap median / max",
        "",
        "| case | " + " | ".join(chosen) + " |",
        "|---" * (len(chosen) + 1) + "|",
    ]
    for name, gaps in hard:
        lines.append(
            f"| {name} | "
            + " | ".join(
                "failed" if gaps[solver] is None else "{:.0e} / {:.0e}".format(*gaps[solver])
                for solver in chosen
            )
            + " |"
        )
    return "\n".join(lines) + "\n"


def markdown(task, rows, missing):
    """The table, with times relative to the first row."""
    lines = [
        (
            f"D {task['D'].shape[0]} x {task['D'].shape[1]}, {task['Y'].shape[1]} signals, "
            f"{SNR_DB:g} dB, lambda {task['lambda']:.2e}; versions: {', '.join(versions())}"
        ),
        "",
        "| solver | signals | CPU ms a signal | times ours | gap median | 95 % | max | non-zeros |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row['solver']} | {row['signals']} | {row['ms']:.2f} | "
            f"{row['ms'] / rows[0]['ms']:.1f} | {row['gap_median']:.0e} | {row['gap_95']:.0e} | "
            f"{row['gap_max']:.0e} | {row['nonzeros']:.0f} |"
        )
    lines += [""] + [f"Not installed: {name}." for name in missing]
    return "\n".join(lines) + "\n"


def versions():
    """Name and version of what was compared."""
    out = [f"numpy {np.__version__}"]
    for name, package in PACKAGES.items():
        try:
            out.append(f"{name} {version(package)}")
        except PackageNotFoundError:
            pass
    return out


def main():
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--run",
        type=Path,
        default=Path("runs/bench-sparse"),
        help="folder of the results; the problem is kept there too",
    )
    parser.add_argument(
        "--config",
        type=Path,
        default=ROOT / "sample_configs" / "seed_spatial.toml",
        help="camera (default: the paper's)",
    )
    parser.add_argument(
        "--iterations", type=int, default=3, help="iterations of the dictionary (default 3)"
    )
    parser.add_argument("--signals", type=int, default=1024, help="signals (default 1024)")
    parser.add_argument("--rounds", type=int, default=3, help="turns of every solver (default 3)")
    parser.add_argument(
        "--lambda-factor", type=float, default=1.0, help="times the best lambda (default 1)"
    )
    parser.add_argument(
        "--solver",
        action="append",
        choices=list(SOLVERS),
        help="only this solver beside ours (repeatable)",
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    options.run.mkdir(parents=True, exist_ok=True)
    kept = options.run / (
        f"problem2-{options.config.stem}-{options.iterations}-{options.signals}-{options.seed}.npz"
    )
    if not kept.exists():
        np.savez(kept, **problem(options.config, options.iterations, options.signals, options.seed))
    with np.load(kept) as stored:
        task = {name: stored[name] for name in stored.files}
    task["lambda"] = float(task["lambda"]) * options.lambda_factor
    rows, missing = measure(task, options.rounds, ["ours", *(options.solver or list(SOLVERS)[1:])])
    text = markdown(task, rows, missing)
    print(text, flush=True)
    quick = [
        name
        for name in ("ours", "SPAMS lasso, Cholesky")
        if name in {row["solver"] for row in rows}
    ]
    hard = measure_hard(task, quick) if options.lambda_factor == 1 else []
    (options.run / "sparse.json").write_text(
        json.dumps(
            {
                "lambda": task["lambda"],
                "validation": task["validation"].tolist(),
                "rows": rows,
                "hard": hard,
                "missing": missing,
                "versions": versions(),
            },
            indent=1,
        )
        + "\n"
    )
    text += "\n" + markdown_hard(hard, quick) if hard else ""
    (options.run / "sparse.md").write_text(text)
    print(markdown_hard(hard, quick) if hard else "")


if __name__ == "__main__":
    main()
