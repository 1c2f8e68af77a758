"""The measured trade of accuracy against time: what the dial promises, what it delivers, and whether its choice was the cheapest.

For each camera and accuracy one child process plans and computes the whole system matrix; three of its columns (centre,
middle, corner) are compared with brute force, which shares no code with the package and is kept in RUN/reference.
Writes RUN/tradeoff.json, .md and .png. Run from the project's root: python pipelines/benchmarks/tradeoff.py --help.
"""

import argparse
import hashlib
import json
import math
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ACCURACIES = [10.0**-n for n in range(1, 9)]
SMALL = {"object.samples_per_lenslet": (16, 16)}
CAMERAS = {
    "seed_spatial": ("seed_spatial", {}),
    "f/2.2": ("seed_spatial_250um", SMALL | {"main_lens.aperture_diameter": 50e-3, "lenslet_array.focal_length": 0.55e-3, "sensor.distance": 0.55e-3,
                                             "lenslet_array.pitch": 249.6e-6 / (1 + 0.55 / 110)}),
    "f/4.4": ("seed_spatial_250um", {}),
    "f/22": ("seed_spatial_250um", SMALL | {"main_lens.aperture_diameter": 5e-3, "lenslet_array.focal_length": 5.5e-3, "sensor.distance": 5.5e-3,
                                            "lenslet_array.pitch": 249.6e-6 / (1 + 5.5 / 110)}),
    "400 nm": ("seed_spatial_250um", SMALL | {"light.wavelengths": (400e-9,), "light.design_wavelength": 400e-9}),
    "10 um LWIR": ("seed_spatial_250um", SMALL | {"light.wavelengths": (10e-6,), "light.design_wavelength": 10e-6}),
    "3-pixel lenslets": ("seed_spatial_250um", SMALL | {"lenslet_array.pitch": 14.4e-6 / (1 + 63.36e-6 / 110e-3), "lenslet_array.focal_length": 63.36e-6,
                                                        "sensor.distance": 63.36e-6, "sensor.pixels_per_lenslet": (3, 3)}),
    "20 um pixels": ("seed_spatial_250um", SMALL | {"sensor.pixel_pitch": 20.8e-6, "sensor.pixels_per_lenslet": (12, 12)}),
    "defocus 1 pitch": ("seed_spatial", SMALL | {"blur": 1}),
    "defocus 5 pitches": ("seed_spatial", SMALL | {"blur": 5, "object.samples_per_lenslet": (10, 10)}),
}
"""Name: (sample configuration, keys changed to SI values; `blur` is the geometric blur in lenslet pitches)."""


def camera_of(name):
    """The camera of a row of the table."""
    from plenocli.config import load_camera

    sample, changes = CAMERAS[name]
    camera, changes = load_camera(ROOT / "sample_configs" / f"{sample}.toml"), dict(changes)
    blur = changes.pop("blur", None)
    if blur:
        lens, array = camera.main_lens, camera.lenslet_array
        eps = blur * array.pitch / (lens.aperture_diameter * array.distance)
        changes["object.distance"] = 1 / (1 / lens.focal_length - 1 / array.distance + eps)
    return camera.replace(**changes)


def places(camera):
    """Flat indices of the points compared: corner, middle, centre."""
    rows, columns = camera.object.samples_per_lenslet
    return [0, int(rows * 0.08) * columns + int(columns * 0.43), rows // 2 * columns + columns // 2]


# brute force


def reference(camera, model, window, superpixels, folder):
    """Columns by brute force: (point, superpixel, pixel row, pixel column), and how far they moved when the window grew.

    window: lenslets either side whose fields add, or None for isolated lenslets. Kept as files in `folder`.
    """
    import numpy as np

    key = hashlib.sha256(json.dumps([camera.text, model, window, superpixels, 3 if window is None else 4]).encode()).hexdigest()[:20]
    path = folder / f"{key}.npz"
    if path.exists():
        with np.load(path) as kept:
            return kept["columns"], float(kept["change"])
    columns = (_exact_columns if model == "exact" else _fresnel_columns)(camera, window, superpixels)
    change = 0.0
    if window is not None:
        own = [(0, 0)]
        # the exact sum affords few lenslets: what those further out do is taken from the paraxial model
        far = _fresnel_columns(camera, window + 3, own) if model == "exact" else columns[:, [superpixels.index((0, 0))]]
        near = _fresnel_columns(camera, window if model == "exact" else window - 2, own)
        change = float(max(np.linalg.norm(a - b) / np.linalg.norm(a) for a, b in zip(far, near)))
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(path, columns=columns, change=change)
    return columns, change


def _image_points(camera):
    rows, columns = camera.object.samples_per_lenslet
    pitch = camera.lenslet_array.pitch
    return [((q // columns - (rows - 1) / 2) * pitch / rows, (q % columns - (columns - 1) / 2) * pitch / columns) for q in places(camera)]


def _pixel_nodes(camera, window):
    """Nodes per pixel for fringes from opposite ends of the coherent window (or of one lenslet), to 1e-10; where lenslets hold many
    diffraction cells, of lenslets up to five apart: those further apart make too little of them (1e-7 of a column)."""
    wavelength, sensor = camera.light.wavelengths[0], camera.sensor
    cell = camera.lenslet_array.pitch * sensor.pixel_pitch / (wavelength * sensor.distance)
    across = 2 * window + 1 if window is not None else 1
    return math.ceil(1.7 * cell + 9 if window is None else 1.7 * cell * (across if _cells(camera) < 15 else min(across, 5)) + 5)


def _cells(camera):
    """Diffraction cells of a lenslet: its pitch over wavelength times F-number."""
    return camera.lenslet_array.pitch * camera.main_lens.aperture_diameter / (camera.light.wavelengths[0] * camera.lenslet_array.distance)


def _fresnel_columns(camera, window, superpixels):
    import numpy as np

    from tests.reference.window import column_energies

    found = []
    for point in _image_points(camera):
        energies = column_energies(camera, camera.light.wavelengths[0], point, window, superpixels, pixel_nodes=_pixel_nodes(camera, window))
        found.append([energies[place] for place in superpixels])
    return np.array(found)


def exact_rows(camera):
    """Pixel rows of the own superpixel that the exact sum is compared on: it costs seconds a row and lenslet."""
    count = camera.sensor.pixels_per_lenslet[0]
    return sorted({int(count * f) for f in (0.04, 0.36, 0.68)})


def exact_window(camera, most, evaluations=2e9):
    """Lenslets either side that the exact sum affords: as many as `most`, at least one, for so many values of the kernel a point."""
    array, sensor = camera.lenslet_array, camera.sensor
    turns = array.pitch / camera.light.wavelengths[0] * (array.pitch / sensor.distance + camera.main_lens.aperture_diameter / array.distance)
    nodes = 20 * math.ceil(2 * math.pi * turns / 36)
    for window in range(most, 1, -1):
        fine = _pixel_nodes(camera, window) ** 2 * len(exact_rows(camera)) * sensor.pixels_per_lenslet[1]
        if (2 * window + 1) ** 2 * fine * nodes**2 <= evaluations:
            return window
    return 1


def _exact_columns(camera, window, superpixels):
    import numpy as np

    from tests.reference.rayleigh import pixel_energies

    far = 0 if window is None else window
    lenslets = [(r, c) for r in range(-far, far + 1) for c in range(-far, far + 1)]
    wavelength, nodes = camera.light.wavelengths[0], _pixel_nodes(camera, window)
    found = [[pixel_energies(camera, wavelength, point, lenslets, (0, 0), rows=exact_rows(camera), pixel_nodes=nodes) for _ in superpixels]
             for point in _image_points(camera)]
    return np.array(found)


# one case, in a process of its own


def run_case(name, accuracy, request, rung):
    """Plan and compute one matrix; a dict of what was estimated and measured. rung: the only one allowed, or None."""
    import numpy as np

    from plenocli.accuracy import dial, plan_pif
    from plenocli.errors import NumericsError
    from plenocli.optics.pif import build_pif

    camera = camera_of(name)
    if rung:
        dial.RUNGS = tuple(r for r in dial.RUNGS if r.name == rung)
    case = {"camera": name, "accuracy": accuracy, "request": request}
    try:
        start = time.perf_counter()
        plan = plan_pif(camera, accuracy=accuracy, **_arguments(request))
        case["plan_seconds"] = time.perf_counter() - start
    except NumericsError as error:
        return case | {"refused": str(error)}
    chosen = next(c for c in plan.candidates if c.why is None)
    case |= {"rung": plan.rung, "model": plan.model, "superpixels": list(plan.superpixels), "coherent_ring": plan.coherent_ring,
             "estimated_error": plan.estimated, "split": plan.split, "estimated_seconds": dial.seconds_here(chosen), "estimated_bytes": plan.memory,
             "double": plan.double, "others": [_other(c, dial) for c in plan.candidates if c is not chosen]}
    before = _resident(reset=True)
    start = time.process_time()
    try:
        pif = build_pif(camera, plan)
    except NumericsError as error:
        return case | {"refused": str(error)}
    case["seconds"] = time.process_time() - start
    case["bytes"] = _resident() - before
    blocks = np.ascontiguousarray(pif.A[0][:, :, places(camera)].transpose(2, 0, 1))
    case["blocks"] = blocks.astype(float)
    return case


def _resident(reset=False):
    """The highest resident memory (bytes) of this process, so far or since it was reset; where Linux does not let reset it, so far."""
    status = Path("/proc/self/status")
    if reset and status.exists():
        try:
            Path("/proc/self/clear_refs").write_text("5")
        except OSError:
            pass
    if status.exists():
        return next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmHWM")) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _arguments(request):
    return {k: tuple(v) if isinstance(v, list) else v for k, v in request.items()}


def _other(candidate, dial):
    known = math.isfinite(candidate.error)
    return {"rung": candidate.name, "why": candidate.why, "estimated_error": candidate.error if known else None,
            "estimated_seconds": dial.seconds_here(candidate) if known else None}


def child(name, accuracy, request, rung, folder):
    """run_case in a fresh process, so that times are cold and memory is its own; the blocks come back through a file."""
    import numpy as np

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "blocks.npz"
    command = [sys.executable, __file__, "--case", json.dumps([name, accuracy, request, rung]), "--run", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    if done.returncode:
        return {"camera": name, "accuracy": accuracy, "request": request, "failed": done.stderr.strip().splitlines()[-1:]}
    case = json.loads(done.stdout.splitlines()[-1])
    if "seconds" in case:
        with np.load(path) as kept:
            case["blocks"] = kept["blocks"]
    return case


def case_main(text, folder):
    """The child's side: prints the case as one line of JSON, leaves the blocks in `folder`."""
    import numpy as np

    case = run_case(*json.loads(text))
    if "blocks" in case:
        np.savez(Path(folder) / "blocks.npz", blocks=case.pop("blocks"))
    print(json.dumps(case))


# the sweep


def measure(case, camera, model, window, folder):
    """Add the achieved error to a case: worst of the three columns, over the superpixels kept (exact model: over some rows of the own one)."""
    import numpy as np

    blocks = case.pop("blocks")
    rows, columns = case["superpixels"]
    reach = [(r, c) for r in range(-(rows // 2), rows // 2 + 1) for c in range(-(columns // 2), columns // 2 + 1)]
    if model == "exact":
        own = blocks[:, reach.index((0, 0))].reshape(len(blocks), *camera.sensor.pixels_per_lenslet)
        blocks, reach = own[:, exact_rows(camera)], [(0, 0)]
        window = None if window is None else exact_window(camera, window)
    truth, change = reference(camera, model, window, reach, folder / "reference")
    errors = [float(np.linalg.norm(b.ravel() - t.ravel()) / np.linalg.norm(t)) for b, t in zip(blocks, truth)]
    case |= {"errors": errors, "achieved": max(errors), "reference_change": change, "reference": model}
    return case


def window_of(camera, scope):
    """Lenslets either side of the object's own that the reference adds coherently: what is beyond changes columns by about 1e-6."""
    if scope == "isolated":
        return None
    blur = abs(1 / camera.object.distance + 1 / camera.lenslet_array.distance - 1 / camera.main_lens.focal_length)
    blur *= camera.main_lens.aperture_diameter * camera.lenslet_array.distance / camera.lenslet_array.pitch
    return math.ceil(blur / 2) + (4 if _cells(camera) > 150 else 6 if _cells(camera) > 60 else 10)


def sweep(names, accuracies, model, scope, run, others=True):
    """All cases as a list of dicts."""
    request = {"model": model} | ({"superpixels": [1, 1], "coherent_ring": 0} if scope == "isolated" else {})
    finest = "fresnel" if model == "fresnel" else "exact"
    cases = []
    for name in names:
        camera = camera_of(name)
        for accuracy in accuracies:
            case = child(name, accuracy, request, None, run)
            if "blocks" in case:
                measure(case, camera, finest, window_of(camera, scope), run)
                if others:
                    _race(case, name, accuracy, request, run)
            case["scope"] = scope
            cases.append(case)
            print(line(case), flush=True)
    return cases


def _race(case, name, accuracy, request, run):
    """Measure the other rungs that would have served, where the dial does not call them ten times slower."""
    for other in case["others"]:
        serves = other["estimated_error"] is not None and other["estimated_error"] <= accuracy
        if serves and other["estimated_seconds"] < 10 * case["estimated_seconds"]:
            again = child(name, accuracy, request, other["rung"], run)
            other["seconds"] = again.get("seconds")
    raced = [o["seconds"] for o in case["others"] if o.get("seconds")]
    case["regret"] = case["seconds"] / min([case["seconds"], *raced])


def verdict(case):
    """held, missed, or open: beyond the accuracy by no more than the reference's own."""
    if case["achieved"] <= case["accuracy"]:
        return "held"
    return "missed" if case["achieved"] > case["accuracy"] + 1.5 * case["reference_change"] else "open"


def line(case):
    """One case in one line of text."""
    head = f"{case['camera']:18s} {case['scope']:9s} {case['accuracy']:7.0e} "
    if "achieved" not in case:
        return head + ("refused: " + case["refused"][:110] if "refused" in case else f"FAILED: {case['failed']}")
    return head + (f"est {case['estimated_error']:.1e} got {case['achieved']:.1e} {verdict(case)} "
                   f"time est {case['estimated_seconds']:.2f} got {case['seconds']:.2f} s, {case['rung']}, {case['superpixels'][0]}x{case['superpixels'][1]} "
                   f"ring {case['coherent_ring']} mem est {case['estimated_bytes'] / 2**20:.0f} got {case['bytes'] / 2**20:.0f} MiB"
                   + (f" (reference {case['reference_change']:.0e})" if case["reference_change"] > 0.1 * case["achieved"] else ""))


def summary(cases):
    """Counts over the cases: how many hold, how honest the estimates are, how often the choice was near the fastest."""
    done = [c for c in cases if "achieved" in c]

    def share(test, among=done):
        return sum(map(test, among)) / len(among) if among else None

    solid = [c for c in done if c["reference_change"] < 0.3 * c["achieved"] or c["scope"] == "isolated"]
    return {
        "cases": len(cases), "computed": len(done), "refused": sum("refused" in c for c in cases), "failed": sum("failed" in c for c in cases),
        **{word: sum(verdict(c) == word for c in done) for word in ("held", "open", "missed")},
        "error_estimate_within_10": share(lambda c: 0.1 <= c["estimated_error"] / max(c["achieved"], 1e-300) <= 10, solid),
        "time_estimate_within_2": share(lambda c: 0.5 <= c["estimated_seconds"] / c["seconds"] <= 2),
        "choice_within_1.5": share(lambda c: c.get("regret", 1) <= 1.5),
        "worst_regret": max((c.get("regret", 1) for c in done), default=None),
    }


def markdown(cases, totals):
    """The table as Markdown."""
    lines = ["| camera | neighbours | asked | estimated | achieved | time est. (s) | time (s) | memory est. (MiB) | memory (MiB) | rung | superpixels | rings | over fastest |",
             "|---|---|---|---|---|---|---|---|---|---|---|---|---|"]
    for c in cases:
        head = f"| {c['camera']} | {c['scope']} | {c['accuracy']:.0e} "
        if "achieved" not in c:
            lines.append(head + f"| refused: {(c.get('refused') or str(c.get('failed'))).splitlines()[0]} |" + " |" * 9)
            continue
        lines.append(head + f"| {c['estimated_error']:.1e} | {c['achieved']:.1e}{'' if verdict(c) == 'held' else f' **{verdict(c)}**'} "
                     f"| {c['estimated_seconds']:.2g} | {c['seconds']:.2g} | {c['estimated_bytes'] / 2**20:.0f} | {c['bytes'] / 2**20:.0f} | {c['rung']} "
                     f"| {c['superpixels'][0]}x{c['superpixels'][1]} | {c['coherent_ring']} | {c.get('regret', 1):.2f} |")
    return "\n".join([*lines, "", *(f"- {k}: {v if not isinstance(v, float) else round(v, 3)}" for k, v in totals.items())]) + "\n"


def plot(cases, path):
    """Asked against achieved, and time against accuracy, one colour a camera."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5), constrained_layout=True)
    names = list(dict.fromkeys(c["camera"] for c in cases))
    for index, name in enumerate(names):
        for scope, style in (("auto", "o-"), ("isolated", "x:")):
            done = [c for c in cases if c["camera"] == name and c["scope"] == scope and "achieved" in c]
            asked = [c["accuracy"] for c in done]
            label = name if scope == "auto" or not any(c["scope"] == "auto" for c in cases) else None
            left.loglog(asked, [c["achieved"] for c in done], style, color=f"C{index}", label=label, ms=4)
            right.loglog(asked, [c["seconds"] for c in done], style, color=f"C{index}", ms=4)
    left.plot([1e-8, 1e-1], [1e-8, 1e-1], "k-", lw=0.8)
    left.set(xlabel="accuracy asked for", ylabel="relative error achieved, worst column", title="solid: with neighbours, dotted: isolated lenslets")
    right.set(xlabel="accuracy asked for", ylabel="CPU time of one core (s)")
    left.legend(fontsize=7)
    figure.savefig(path, dpi=130, metadata={"Software": None})
    plt.close(figure)


def main():
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", default="runs/tradeoff", help="folder of the results and of the brute-force columns that are kept")
    parser.add_argument("--camera", action="append", choices=list(CAMERAS), help="only this camera (repeatable)")
    parser.add_argument("--accuracy", action="append", type=float, help="only this accuracy (repeatable)")
    parser.add_argument("--model", default="auto", choices=["auto", "fresnel", "exact"], help="auto: against the exact model; else within the model")
    parser.add_argument("--scope", default="both", choices=["both", "auto", "isolated"], help="with neighbours as the dial finds right, or one lenslet alone")
    parser.add_argument("--no-race", action="store_true", help="do not time the other rungs that would serve")
    parser.add_argument("--case", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        return case_main(options.case, options.run)
    run = ROOT / options.run
    cases = []
    for scope in ("auto", "isolated") if options.scope == "both" else (options.scope,):
        cases += sweep(options.camera or CAMERAS, options.accuracy or ACCURACIES, options.model, scope, run, not options.no_race)
    totals = summary(cases)
    (run / "tradeoff.json").write_text(json.dumps({"model": options.model, "summary": totals, "cases": cases}, indent=1) + "\n")
    (run / "tradeoff.md").write_text(markdown(cases, totals))
    plot(cases, run / "tradeoff.png")
    print(json.dumps(totals, indent=1))


if __name__ == "__main__":
    main()
