"""What Algorithm 1 gains, iteration by iteration, on five photographs that it does not see: PSNR of
one coding of every lenslet's field, and of the mean over mirror images that `reconstruct --method
dictionary` takes; with the atoms that code and, at both ends, with those that paint.

python pipelines/learning.py PIF OUT.csv [ITERATIONS]: PIF of one isolated lenslet, as spatial.mk
leaves it. Three minutes of CPU at 40x40 points.
"""

import csv
import sys
from io import StringIO
from pathlib import Path

import numpy as np

from plenocli.files.atomic import publish
from plenocli.files.read.scenes import read_scene
from plenocli.files.read.system_matrices import read_lenslet_matrix
from plenocli.files.read.training import read_training
from plenocli.inverse.picture.solvers.least_squares import decompose
from plenocli.inverse.prior.natural_images import at_scales, split_by_scene
from plenocli.inverse.sparse.dictionary import INCOHERENCE, PULL, Settings, averaged, psnr
from plenocli.inverse.sparse.learning import advance, learner_for

JUDGES = ("astronaut", "coffee", "chelsea", "rocket", "moon")
LEARNT_FROM = (
    *("camera", "coins", "brick", "grass", "gravel"),
    *("motorcycle_left", "retina", "hubble_deep_field"),
)
LENSLETS = 11
COLUMNS = ("iteration", "atoms", "picture", "one_coding_db", "mean_over_mirrors_db")


def fields(name, shape):
    """The fields (point, lenslet) of LENSLETS x LENSLETS lenslets that see a photograph."""
    rows, columns = shape
    scene = read_scene(f"skimage:{name}")
    whole = np.asarray(scene.at(550e-9, LENSLETS * rows, LENSLETS * columns), float)
    parts = whole.reshape(LENSLETS, rows, LENSLETS, columns).swapaxes(1, 2)
    return parts.reshape(LENSLETS**2, -1).T


def judged(machine, atoms, paint, seen):
    """[(picture, dB of one coding, dB of the mean over mirror images)]."""
    for name, (truth, measured) in seen.items():
        one = paint @ machine.code(atoms, measured).c
        mean = averaged(
            machine.seen,
            atoms,
            measured,
            machine.settings.lam,
            machine.object_shape,
            synthesis=paint,
            workers=machine.workers,
        ).x
        yield name, psnr(one, truth), psnr(mean, truth)


def main(pif, output, iterations="10"):
    """Learn, judge, write the table."""
    system = read_lenslet_matrix(Path(pif))
    shape = system.object_shape
    pictures = read_training([f"skimage:{name}" for name in LEARNT_FROM], shape)
    training, held_out = (at_scales(part, shape) for part in split_by_scene(pictures))
    count = int(np.prod(shape))
    settings = Settings(
        atoms=count,
        batch=4 * count,
        lam=np.nan,
        lam_rule="validation",
        delta=1e-3,
        pull=PULL,
        incoherence=INCOHERENCE,
        snr_db=60.0,
        seed=3,
    )
    parts = [[picture for _, picture in part] for part in (training, held_out)]
    machine = learner_for(decompose(system.own), shape, settings, *parts, workers=1)
    rng = np.random.default_rng(5)
    truths = {name: fields(name, shape) for name in JUDGES}
    seen = {name: (truth, machine.measure(truth, rng)[0]) for name, truth in truths.items()}
    state, rows = machine.start(), []
    for done in range(int(iterations) + 1):
        if done:
            machine, state = advance(machine, state)
        kinds = {"that code": state.atoms}
        if done in (0, int(iterations)):
            kinds["that paint"] = machine.synthesis(state)
        for kind, paint in kinds.items():
            found = list(judged(machine, state.atoms, paint, seen))
            mean = np.mean([row[1:] for row in found], axis=0)
            found.append(("mean", *mean))
            rows += [(done, kind, name, f"{a:.3f}", f"{b:.3f}") for name, a, b in found]
            print(
                f"{done} iterations, atoms {kind}: {mean[0]:.2f} dB by one coding, {mean[1]:.2f} "
                "dB over mirror images",
                flush=True,
            )
    text = StringIO()
    csv.writer(text, lineterminator="\n").writerows([COLUMNS, *rows])
    publish(Path(output), text.getvalue().encode(), overwrite=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
