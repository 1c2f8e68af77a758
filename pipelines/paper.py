"""The figures of Berkner et al. 2013, 1 to 10, made anew on one page: what the paper says, what
comes out here, and one word (agrees, disagrees, cannot be told) with the reason.

python pipelines/paper.py SPATIAL_RUN SPECTRAL_RUN LEARNING.csv PAGE.html: as paper.mk calls it.
"""

import csv
import sys
from functools import partial
from pathlib import Path

import numpy as np

from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.shards import read_pif
from plenocli.files.atomic import publish
from plenocli.files.config.camera_file import parse_camera
from plenocli.files.images.mosaic import read_capture
from plenocli.files.read.training import DEFAULT, linear_values
from plenocli.files.results.matrices import matrix_of
from plenocli.files.results.results import read_block, read_result
from plenocli.files.results.scores import read_scores
from plenocli.files.results.truths import read_truth
from plenocli.report import figures, pictures, spectral_pictures
from plenocli.report.drawing import drawing, show_picture
from plenocli.report.page import Page

PAPER_NNLS, PAPER_DICTIONARY = 22.5, 26.1
"""dB that the paper has on its doll (section 3-2)."""

COLUMNS = ("figure", "the paper", "here", "verdict", "why")


def main(spatial, spectral, learning, output):
    """Write the page; files that are missing are an error of the run before."""
    spatial, spectral = Path(spatial), Path(spectral)
    parts = {
        "Fig. 1": (_system, spectral),
        "Fig. 2": (_chain, spectral),
        "Fig. 3": (_columns, spatial),
        "Fig. 5": (_prototype, spectral),
        "Fig. 6": (_bands, spectral),
        "Fig. 7": (_errors, spectral),
        "Fig. 8": (_photograph, spectral),
        "Figs. 4 and 9": (partial(_learnt, gains=_gains(learning)), spatial),
        "Fig. 10": (_reconstructed, spatial),
    }
    made = {name: draw(run) for name, (draw, run) in parts.items()}
    rows = [(name, *row) for name, (_, verdicts) in made.items() for row in verdicts]
    page = Page(
        "The paper's figures, computed",
        (
            "K. Berkner, L. Meng, S. A. Shroff, I. Tosic, End-to-end System Model for Plenoptic "
            "Cameras (2013): what it shows and says, and what plenocli gives."
        ),
    )
    page.section("Verdicts")
    page.table(COLUMNS, rows, text=True)
    for name, (drawn, verdicts) in made.items():
        page.section(name, ". ".join(row[0] for row in verdicts) + ".")
        page.figures(drawn)
    publish(Path(output), page.render().encode(), overwrite=True)
    for row in rows:
        print("| " + " | ".join(row) + " |")


def _word(agrees):
    return "agrees" if agrees else "disagrees"


def _camera(run):
    return parse_camera(read_artefact(run / "predicted.h5").provenance.config)


def _system(run):
    camera = _camera(run)
    lens, array, sensor = camera.main_lens, camera.lenslet_array, camera.sensor
    half, pitch = lens.aperture_diameter / 2, array.pitch
    colours = {"450 nm": "#3050c0", "570 nm": "#c0a000"}
    with drawing(8.4, 3.6) as made:
        left, right = made.figure.subplots(1, 2, width_ratios=(3, 1))
        for centre in (-pitch, 0, pitch):
            for sign, colour in zip((1, -1), colours.values(), strict=True):
                for height in np.array([0.1, 0.9]) * sign * half:
                    rise = (centre - height) / array.distance
                    end = centre + sensor.distance * (rise - centre / array.focal_length)
                    left.plot([0, array.distance * 1e3], [height * 1e3, centre * 1e3], color=colour)
                    right.plot([0, sensor.distance * 1e6], [centre * 1e6, end * 1e6], color=colour)
        left.plot([0, 0], [-half * 1e3, half * 1e3], color="black", linewidth=3)
        left.set(
            title="main lens with filters (bar) to lenslets",
            xlabel="behind the lens [mm]",
            ylabel="height [mm]",
        )
        right.set(
            title="lenslets to sensor", xlabel="behind the lenslets [um]", ylabel="height [um]"
        )
    return [(made.png, "Rays through two cells of the pupil (blue 450 nm, yellow 570 nm).")], [
        (
            "Filters in the main lens, lenslets before the sensor: each lenslet images the filters",
            f"{array.count[0]} x {array.count[1]} lenslets of "
            f"{'x'.join(map(str, sensor.pixels_per_lenslet))} pixels",
            "agrees",
            "a drawing of what is simulated; the paper gives no dimensions",
        )
    ]


def _chain(_run):
    boxes = (
        "source\nscene, light",
        "optics\nsimulate-pif",
        "detector\ncapture-sim",
        "processing\ndemux, learn-dict,\nreconstruct",
        "metrics\nscore, sweep",
    )
    with drawing(9.6, 1.5) as made:
        axes = made.figure.subplots()
        axes.set(xlim=(-0.5, len(boxes) - 0.5), ylim=(-1, 1))
        axes.set_axis_off()
        for place, box in enumerate(boxes):
            axes.text(
                place, 0, box, ha="center", va="center", bbox={"fc": "white", "boxstyle": "round"}
            )
        for place in range(len(boxes) - 1):
            axes.annotate("", (place + 0.68, 0), (place + 0.36, 0), arrowprops={"arrowstyle": "->"})
    return [(made.png, "The parts of the model and the commands that compute them.")], [
        (
            "Models of source, optics, detector, processing and metrics make one system model",
            "all five, each a command",
            "agrees",
            "every figure below is a run through them",
        )
    ]


def _columns(run):
    matrix = matrix_of(read_pif(run / "pif.h5"))
    rows, columns = matrix.object_shape
    steps = (0, columns // 8, columns // 3 - 1, columns // 2 - 1)
    points = [(rows // 2, columns // 2 + step) for step in steps]
    seen = np.array([matrix.own[:, r * columns + c] for r, c in points])
    first, *others = seen.reshape(-1, *matrix.pixel_shape)
    alike = [_best_correlation(first, other) for other in others]
    # what all points have in common is the image of the pupil
    mean = matrix.own.mean(axis=1)
    fringes = seen - np.outer(seen.sum(axis=1) / mean.sum(), mean)
    moved = np.corrcoef(fringes)[0, 1:]
    found = ", ".join(
        f"{a:.3f} and {m:.2f} ({k})" for a, m, k in zip(alike, moved, steps[1:], strict=True)
    )
    share = np.linalg.norm(fringes[0]) / np.linalg.norm(seen[0])
    return figures.matrix_figures(matrix, points)[:1], [
        (
            "Of a point on the axis and of points a small distance off it the sensor sees quite "
            "different patterns, which no geometric model gives",
            f"correlation with the pattern on the axis after the best shift, and of the fringes on "
            f"it ({share:.0%} of it), of points so many of {columns} off: {found}",
            _word(alike[1] < 0.9),
            "the object is in focus here and the lens free of aberrations: every point lights the "
            "image of the pupil, and only fringes change but at the lenslet's edge; these change "
            "as the paper says, and no geometric model has them",
        )
    ]


def _best_correlation(one, other):
    """Largest correlation of two patterns over all (circular) shifts by whole pixels."""
    one, other = ((p - p.mean()) / np.linalg.norm(p - p.mean()) for p in (one, other))
    return float(np.fft.ifft2(np.fft.fft2(one) * np.conj(np.fft.fft2(other))).real.max())


def _response(run):
    """(F (pixel, band), condition, smallest angle between two columns in degrees)."""
    matrix = read_artefact(run / "measured.h5").data["response/F"]
    unit = matrix / np.linalg.norm(matrix, axis=0)
    cosine = (unit.T @ unit)[np.triu_indices(matrix.shape[1], 1)].max()
    return matrix, float(np.linalg.cond(matrix)), float(np.degrees(np.arccos(cosine)))


def _prototype(run):
    chart = read_capture(run / "raw" / "chart-long.dng")
    centres = read_artefact(run / "measured.h5").data["grid/centre"]
    _, condition, angle = _response(run)
    filters = spectral_pictures.filters_picture(_camera(run))
    return [
        (filters, "Filters in the pupil and their transmittance."),
        *figures.capture_figures(chart, "chart-long.dng", centres),
    ], [
        (
            "A prototype with four narrow-band filters (450, 540, 570, 650 nm) in the main lens",
            f"the same bands before a singlet and a Bayer sensor; F has condition {condition:.2f}, "
            f"columns {angle:.0f} degrees apart at least",
            "cannot be told",
            "widths of the filters, lenslets and sensor are not given",
        )
    ]


def _bands(run):
    centres = read_artefact(run / "measured.h5").data["grid/centre"]
    matrix, _, _ = _response(run)
    unit = matrix / np.linalg.norm(matrix, axis=0)
    drawn = [
        figure
        for nm in (540, 650)
        for figure in figures.capture_figures(
            read_capture(run / "raw" / f"band-{nm}nm.dng"), f"band-{nm}nm.dng", centres
        )
    ]
    return drawn, [
        (
            "Calibration at 540 and 650 nm: each band lights other pixels of a superpixel",
            f"cosine of the two responses {unit[:, 1] @ unit[:, 3]:.2f}; of 540 and 570 nm, on "
            f"pixels of one colour, {unit[:, 1] @ unit[:, 2]:.2f}",
            "agrees",
            "540 and 650 nm light pixels of other colours; the filters' images are blurred here, "
            "so that there is something to demultiplex, more than in the paper's print",
        )
    ]


def _errors(run):
    entries, found = [], {}
    for exposure in ("long", "short"):
        for one in read_scores(run / f"score-measured-{exposure}.json").results:
            entries.append(one)
            found[exposure, Path(one.name).stem.removeprefix(f"chart-{exposure}-")] = [
                one.number(name)
                for name in ("six_patch_rmse", "snr_capture_mean_db", "nearest_patch_accuracy")
            ]
    pairs = [(found[e, "pinv"], found[e, "single-pixel"]) for e in ("long", "short")]
    error, snr, told = (
        "; ".join(f"{a[k]:.{digits}f} against {b[k]:.{digits}f}" for a, b in pairs)
        for k, digits in ((0, 4), (1, 1), (2, 3))
    )
    better = max(a[0] / b[0] for a, b in pairs)
    return [
        (
            spectral_pictures.accuracy_bars(entries),
            "Error over the six patches and SNR on white, by band, at both exposures.",
        )
    ], [
        (
            "Over six patches the error of demultiplexing is comparable to single pixel's",
            f"{error} (long; short exposure)",
            _word(0.67 < better < 1.5),
            "columns of F overlap here, so that a single pixel holds light of other bands",
        ),
        (
            "Demultiplexing has a much higher SNR on white at two exposures",
            f"{snr} dB",
            _word(min(a[1] - b[1] for a, b in pairs) > 3),
            "it uses all pixels of a superpixel instead of four",
        ),
        (
            "Spectra may be judged by classification (section 2-2; no figure)",
            f"lenslets that tell their patch of 24: {told}",
            "cannot be told",
            "the paper shows no classification",
        ),
    ]


def _photograph(run):
    with drawing(9.6, 3.6) as made:
        for axes, (method, name) in zip(
            made.figure.subplots(1, 2),
            (("single-pixel", "single pixel"), ("pinv", "demultiplexed")),
            strict=True,
        ):
            result = read_result(run / "spectra" / "measured" / f"photo-{method}.h5")
            band = int(np.argmin(np.abs(result.wavelengths - 650e-9)))
            show_picture(
                axes,
                result.values[band] / np.nanpercentile(result.values[band], 99.5),
                f"{name}, {result.wavelengths[band] * 1e9:.0f} nm",
            )
    scores = {
        Path(one.name).stem.removeprefix("chart-short-"): one.bands("snr_capture_db")[band]
        for one in read_scores(run / "score-measured-short.json").results
    }
    gain = scores["pinv"] - scores["single-pixel"]
    return [(made.png, "A photograph at the short exposure, one value a lenslet.")], [
        (
            "An image of a hand at 650 nm: less noise demultiplexed (right) than by single pixel",
            f"{gain:.1f} dB more at 650 nm, on white at the exposure of the picture",
            _word(gain > 3),
            "another photograph; noise is seen in single pixel's",
        )
    ]


def _noiselike(atoms, shape, lag=3):
    """Which atoms (point, atom) but the first correlate below 0.3 with themselves `lag` off."""
    pictures_ = atoms.T.reshape(-1, *shape)
    a, b = pictures_[:, :, lag:], pictures_[:, :, :-lag]
    norm = np.sqrt((a**2).sum((1, 2)) * (b**2).sum((1, 2)))
    return (a * b).sum((1, 2))[1:] / norm[1:] < 0.3


def _gains(table):
    """{(iteration, atoms): (dB of one coding, dB over mirror images)}, means of five pictures."""
    with open(table, newline="") as rows:
        return {
            (int(row["iteration"]), row["atoms"]): (
                float(row["one_coding_db"]),
                float(row["mean_over_mirrors_db"]),
            )
            for row in csv.DictReader(rows)
            if row["picture"] == "mean"
        }


def _learning_curve(gains):
    with drawing(6.4, 3.2) as made:
        axes = made.figure.subplots()
        for kind, mark in (("that code", "o-"), ("that paint", "s--")):
            done = [n for n, atoms in gains if atoms == kind]
            for k, name in enumerate(("one coding", "mean over mirror images")):
                axes.plot(
                    done,
                    [gains[n, kind][k] for n in done],
                    mark,
                    color=("#0072b2", "#d55e00")[k],
                    label=f"{name}, by the atoms {kind}",
                )
        axes.set(xlabel="iteration (0: patches that learning starts from)", ylabel="PSNR [dB]")
        axes.legend(loc="lower right")
    return made.png


def _learnt(run, gains):
    matrix = matrix_of(read_pif(run / "pif.h5"))
    result = read_result(run / "dictionary.h5")
    start = read_result(run / "unlearned.h5")
    before, after = (_noiselike(r.values, matrix.object_shape) for r in (start, result))
    done = max(gains)[0]
    (code, code_mean), (paint, paint_mean) = (
        np.subtract(gains[done, kind], gains[0, kind]) for kind in ("that code", "that paint")
    )
    history = {name: np.asarray(values) for name, values in result.history.items()}
    with drawing(6.4, 3.3) as made:
        for axes, name in zip(made.figure.subplots(1, 2), DEFAULT[1:3], strict=True):
            show_picture(axes, linear_values(name), name.removeprefix("skimage:"))
    return [
        *figures.matrix_figures(matrix)[1:2],
        (made.png, "Two of the training pictures; patches of 40 x 40 points come from anywhere."),
        *figures.dictionary_figures(result, "dictionary.h5", matrix),
        (
            _learning_curve(gains),
            "Fields of lenslets of five photographs that were not learnt from, mean PSNR.",
        ),
    ], [
        (
            "Algorithm 1 learns atoms of objects that the sensor sees well",
            f"{done} iterations, lenslets of five other photographs: {code:+.2f} dB for one coding "
            f"by the learnt atoms, {code_mean:+.2f} for its mean over mirror images; "
            f"{paint:+.2f} and {paint_mean:+.2f} where atoms that paint are regressed for both",
            _word(code >= 0.3),
            "with a pull towards the atoms so far; the regression and the mean over mirror images "
            "give untaught patches most of that gain",
        ),
        (
            "Atoms look like pieces of scenes",
            f"{before.mean():.0%} of the atoms are as rough as noise at the start (grass, gravel), "
            f"{after.mean():.0%} learnt; {np.mean(after & ~before):.0%} became so",
            _word(after.mean() <= before.mean()),
            "rough: points three apart correlate by less than 0.3; as published most atoms turn "
            "into noise",
        ),
        (
            "A and the dictionary need a mutual coherence far below 1",
            f"mean coherence of A Phi {history['coherence_mean'][-1]:.2f}, largest "
            f"{history['coherence_max'][-1]:.2f} (constant atom left out)",
            _word(history["coherence_max"][-1] < 0.3),
            "photographs and the camera are both smooth",
        ),
    ]


def _blocking(values, truth, block):
    """Mean step of the error across the lenslets' borders over that elsewhere."""
    steps = np.abs(np.diff(values - truth, axis=1)).mean(axis=0)
    border = np.arange(1, len(steps) + 1) % block[1] == 0
    return steps[border].mean() / steps[~border].mean()


def _curve(nnls, others):
    with drawing(6.4, 3.2) as made:
        axes = made.figure.subplots()
        axes.semilogx(list(nnls), list(nnls.values()), "o-", label="NNLS")
        axes.set_xticks(list(nnls), [str(n) for n in nnls], minor=False)
        for (name, value), style in zip(others.items(), ("-", "--", ":"), strict=False):
            axes.axhline(value, linestyle=style, color="#777777", label=f"{name}, {value:.1f} dB")
        axes.axhline(PAPER_NNLS, color="#c03030", label=f"the paper's NNLS, {PAPER_NNLS} dB")
        axes.set(xlabel="steps of NNLS", ylabel="PSNR [dB]")
        axes.legend(loc="lower right")
    return made.png


def _reconstructed(run):
    truth = run / "paper" / "capture.h5"
    scores = {
        Path(one.name).stem: one.number("psnr_db")
        for one in read_scores(run / "score-paper.json").results
    }
    nnls = {int(n.removeprefix("nnls-")): v for n, v in scores.items() if n.startswith("nnls-")}
    nnls = dict(sorted(nnls.items()))
    names = [f"nnls-{max(nnls)}", "lmmse", "unlearned", "dictionary", "lmmse-3x3", "pnp"]
    results = [read_result(run / "paper" / f"{n}.h5") for n in names]
    true, block = read_truth(truth, results[0]).window(), read_block(results[0], truth)
    entries = [(n, r.values, f"{scores[n]:.2f} dB") for n, r in zip(names, results, strict=True)]
    steps = {n: _blocking(r.values, true, block) for n, r in zip(names, results, strict=True)}
    learnt, doll = scores["dictionary"], run.name == "doll"
    gains = f"{learnt - max(nnls.values()):.1f} to {learnt - min(nnls.values()):.1f} dB"
    learning = learnt - scores["unlearned"]
    drawn = [
        *figures.capture_figures(read_capture(truth), "the sensor data"),
        (
            _curve(nnls, {n: scores[n] for n in ("dictionary", "lmmse", "unlearned")}),
            "Non-negative least squares by the step at which it stops.",
        ),
        (
            pictures.reconstructions(entries, true),
            ("The doll" if doll else "The astronaut in the doll's place")
            + "; each result above its error.",
        ),
        (pictures.close_ups(entries, true, block), "Close-up of the middle lenslets."),
    ]
    return drawn, [
        (
            f"Non-linear least squares {PAPER_NNLS} dB",
            ", ".join(f"{v:.1f} dB at {n}" for n, v in nnls.items()) + " steps",
            "cannot be told",
            "the step where it stopped is not given, and the figure depends on it",
        ),
        (
            f"The learnt dictionary {PAPER_DICTIONARY} dB, "
            f"{PAPER_DICTIONARY - PAPER_NNLS:.1f} dB above least squares",
            f"{learnt:.1f} dB; {gains} above that curve, "
            f"{learnt - scores['lmmse']:.1f} above LMMSE",
            _word(abs(learnt - PAPER_DICTIONARY) < 1) if doll else "cannot be told",
            "the same picture" if doll else "another picture; DOLL=file takes the paper's",
        ),
        (
            "The gain is that of learning",
            f"{learning:.2f} dB over the patches that learning starts from",
            _word(learning > 0.3),
            "same capture, same method; at least 0.3 dB are asked for here",
        ),
        (
            "Blocking goes when 3x3 lenslets are reconstructed and averaged",
            f"step of the error at lenslets' borders over that inside: dictionary "
            f"{steps['dictionary']:.2f}, LMMSE {steps['lmmse']:.2f}, over 3x3 lenslets "
            f"{steps['lmmse-3x3']:.2f}",
            _word(steps["lmmse-3x3"] < steps["lmmse"]),
            "by LMMSE over 3x3 lenslets, not by a dictionary of 3x3 lenslets",
        ),
    ]


if __name__ == "__main__":
    main(*sys.argv[1:5])
