"""The measured trade of accuracy against time: what the dial promises, what it delivers, and
whether its choice was the cheapest.

Ten cameras, eight accuracies, within the paraxial model and against the exact one, each for
isolated lenslets and with the coherent neighbours that the dial finds right. For each case the dial
plans; what is not refused is computed, cheap cases first, in a process of its own; three columns
(centre, middle, corner) are compared with brute force (tradeoff_truth.py); rungs that the dial
passed over are timed too where they might have served. Cases that are estimated above the budget
are listed with the estimate. What was measured is kept in RUN/cases and RUN/reference: a rerun
computes only what a new plan or new code changes. Writes RUN/tradeoff.json, .md and .png. Run from
the project's root: python pipelines/benchmarks/tradeoff.py --help.
"""

import argparse
import hashlib
import json
import os
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from multiprocessing import get_context
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402

# as all else that is imported, it is there before time is taken
import scipy.sparse  # noqa: E402, F401
from model_code import model_code  # noqa: E402
from tradeoff_truth import CAMERAS, ROOT, Truth, camera_of, places, truth_for  # noqa: E402

from plenocli.base.errors import NumericsError  # noqa: E402
from plenocli.files.artefacts import pif_pieces  # noqa: E402
from plenocli.files.config.camera_file import to_toml  # noqa: E402
from plenocli.forward.accuracy import dial  # noqa: E402
from plenocli.forward.accuracy.dial import plan_pif  # noqa: E402
from plenocli.forward.propagation.system_matrix import build_pif  # noqa: E402

ACCURACIES = [10.0**-n for n in range(1, 9)]
SUITES = [(model, scope) for model in ("fresnel", "auto") for scope in ("isolated", "neighbours")]
NEAR = 3.0
"""A rung that was passed over is timed if its estimated error is at most so many
times what was asked.
"""


# planning


def plan_case(model, scope, name, accuracy):
    """One case as a dict: what the dial says, with the candidates under "_" keys, or "refused", for
    its error or for the memory that the command allows by default.
    """
    case = {"camera": name, "accuracy": accuracy, "model": model, "scope": scope}
    try:
        start = time.process_time()
        plan = plan_pif(camera_of(name), accuracy=accuracy, **request_of(model, scope))
        case["plan_seconds"] = time.process_time() - start
        pif_pieces.layout(plan, name)
    except NumericsError as error:
        return case | {"refused": str(error)}
    chosen = plan.chosen
    others = [
        c for c in plan.candidates if c is not chosen and c.error <= NEAR * accuracy and c.bands
    ]
    return case | {
        "rung": plan.rung,
        "superpixels": list(plan.superpixels),
        "coherent_ring": plan.coherent_ring,
        "estimated_error": plan.estimated,
        "split": plan.split,
        "estimated_bytes": plan.memory,
        "dtype": plan.dtype,
        "_chosen": chosen,
        "_others": others,
    }


def request_of(model, scope):
    """Keyword arguments of plan_pif."""
    return {"model": model} | (
        {"superpixels": (1, 1), "coherent_ring": 0} if scope == "isolated" else {}
    )


def forced(name):
    """Have the dial take the rung `name` in this process, whatever it thinks of its error."""
    dial._cheapest = lambda found: next(c for c in found if c.name == name)


@cache
def code_of(name):
    """Digest of the code that computes the model `name`."""
    return model_code(name, ROOT)


def record_path(run, case, candidate, truth):
    """Where the measurement of a candidate is kept: by what is computed and what
    it is compared with.
    """
    what = [
        to_toml(camera_of(case["camera"])),
        case["superpixels"],
        case["dtype"],
        candidate.name,
        candidate.ring,
        f"{candidate.sampling:.3g}",
        candidate.double,
        repr(candidate.bands),
        candidate.band_nodes,
        truth.key,
        code_of(candidate.name),
    ]
    return run / "cases" / f"{hashlib.sha256(json.dumps(what).encode()).hexdigest()[:20]}.json"


# one measurement, in a process of its own


def compute(name, accuracy, model, scope, rung):
    """Plan and compute one matrix by `rung`: (what was measured, its three columns or None)."""
    forced(rung)
    camera = camera_of(name)
    plan = plan_pif(camera, accuracy=accuracy, **request_of(model, scope))
    dial.product_rate.cache_clear()
    rates = [dial.product_rate(double) for double in (False, True)]
    before = _resident(reset=True)
    start = time.process_time()
    try:
        pif = build_pif(camera, plan)
    except NumericsError as error:
        return {"refused": str(error)}, None
    seconds = time.process_time() - start
    notes = {k: v for k, v in pif.notes.as_json().items() if isinstance(v, (int, float))}
    found = {
        "seconds": seconds,
        "bytes": _resident() - before,
        "rates": rates,
        "load": os.getloadavg()[0],
        "notes": notes,
    }
    return found, np.ascontiguousarray(pif.A[0][:, :, places(camera)].transpose(2, 0, 1)).astype(
        float
    )


def _resident(reset=False):
    """The highest resident memory (bytes) of this process, so far or since it was reset; where
    Linux does not let reset it, so far.
    """
    status = Path("/proc/self/status")
    if reset and status.exists():
        try:
            Path("/proc/self/clear_refs").write_text("5")
        except OSError:
            pass
    if status.exists():
        return (
            next(
                int(line.split()[1])
                for line in status.read_text().splitlines()
                if line.startswith("VmHWM")
            )
            * 1024
        )
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def measured(run, case, candidate, truth):
    """What was measured of a candidate: from RUN/cases, or now, cold and with memory of its own."""
    path = record_path(run, case, candidate, truth)
    if path.exists():
        return json.loads(path.read_text())
    path.parent.mkdir(parents=True, exist_ok=True)
    # a fork has the imports but nothing that a matrix leaves behind
    with ProcessPoolExecutor(1, get_context("fork")) as pool:
        try:
            found, columns = pool.submit(
                compute,
                case["camera"],
                case["accuracy"],
                case["model"],
                case["scope"],
                candidate.name,
            ).result()
        except (BrokenProcessPool, MemoryError) as error:
            return {"failed": str(error)}
    if columns is not None:
        columns = truth.pick(columns, reach_of(case))
        found["errors"] = [
            float(np.linalg.norm(a - b) / np.linalg.norm(b))
            for a, b in zip(columns, truth.columns())
        ]
        found |= {
            "change": truth.change(),
            "window": truth.window,
            "camera": case["camera"],
            "rung": candidate.name,
            "accuracy": case["accuracy"],
        }
    path.write_text(json.dumps(found, indent=1) + "\n")
    return found


def reach_of(case):
    """(row, column) of the superpixels of a case, in the matrix's order."""
    rows, columns = case["superpixels"]
    return [
        (r, c)
        for r in range(-(rows // 2), rows // 2 + 1)
        for c in range(-(columns // 2), columns // 2 + 1)
    ]


# the sweep


def truth_of(run, case, kept_only=False):
    """The Truth of a case; asking for it may take a paraxial sum, unless it is to be of what is
    kept only: then it may be None.
    """
    model, neighbours = (
        "fresnel" if case["model"] == "fresnel" else "exact",
        case["scope"] == "neighbours",
    )
    return truth_for(
        camera_of(case["camera"]),
        model,
        neighbours,
        reach_of(case),
        case["accuracy"],
        run / "reference",
        kept_only,
    )


def expected(run, cases, budget):
    """(seconds of the matrices, seconds of the brute-force columns) that are still to
    be computed, about.
    """
    matrices, truths = 0.0, {}
    for case in cases:
        if case["model"] == "auto" and case["scope"] == "neighbours":
            # which lenslets the exact sum needs is found by paraxial sums
            truth = Truth(
                camera_of(case["camera"]),
                "exact",
                1 if case["accuracy"] > 2e-3 else 2 if case["accuracy"] > 2e-4 else 3,
                reach_of(case),
                run / "reference",
            )
            todo = [case["_chosen"], *case["_others"]]
        else:
            truth = truth_of(run, case)
            todo = [
                c
                for c in (case["_chosen"], *case["_others"])
                if not record_path(run, case, c, truth).exists()
            ]
        matrices += sum(0.5 + dial.seconds_here(c) for c in todo if dial.seconds_here(c) <= budget)
        if todo and truth.affordable():
            truths[truth.key] = truth.seconds()
    return matrices, sum(truths.values())


def run_case(run, case, budget, race, kept_only=False):
    """Fill in what was measured of a case, of its chosen rung and of those it was chosen from."""
    chosen, others = case["_chosen"], case["_others"]
    truth = truth_of(run, case, kept_only)
    if kept_only and not (truth and record_path(run, case, chosen, truth).exists()):
        return case | {"not_run": f"estimated {dial.seconds_here(chosen):.0f} s"}
    if truth is None:
        return case | {"not_run": "brute force cannot be afforded"}
    found = measured(run, case, chosen, truth)
    if "errors" not in found:
        return case | found
    case |= {
        "seconds": found["seconds"],
        "bytes": found["bytes"],
        "load": found["load"],
        "errors": found["errors"],
        "achieved": max(found["errors"]),
        "reference_change": found["change"],
        "estimated_seconds": chosen.seconds(lambda double: found["rates"][double]),
        "others": [],
    }
    for other in others if race else ():
        # what serves is timed unless it is hopeless; what is thought too coarse, only if it
        # would have been faster
        limit = min(
            budget,
            4 * max(chosen.seconds(), 0.01)
            if other.error <= case["accuracy"]
            else chosen.seconds(),
        )
        if other.seconds() <= limit and (
            not kept_only or record_path(run, case, other, truth).exists()
        ):
            again = measured(run, case, other, truth)
            if "errors" in again:
                case["others"].append(
                    {
                        "rung": other.name,
                        "estimated_error": other.error,
                        "achieved": max(again["errors"]),
                        "seconds": again["seconds"],
                        "estimated_seconds": other.seconds(
                            lambda double, again=again: again["rates"][double]
                        ),
                    }
                )
    adequate = [o["seconds"] for o in case["others"] if o["achieved"] <= case["accuracy"]]
    case["regret"] = case["seconds"] / min([case["seconds"], *adequate])
    return case


def verdict(case):
    """held, missed, or open: beyond the accuracy by no more than the reference's own."""
    if case["achieved"] <= case["accuracy"]:
        return "held"
    return (
        "missed" if case["achieved"] > case["accuracy"] + 1.5 * case["reference_change"] else "open"
    )


def line(case):
    """One case in one line of text."""
    head = f"{case['model']:8s} {case['scope']:10s} {case['camera']:18s} {case['accuracy']:7.0e} "
    if "achieved" not in case:
        return head + next(
            f"{word}: {str(case[word])[:110]}"
            for word in ("refused", "not_run", "failed")
            if word in case
        )
    return head + (
        (
            f"est {case['estimated_error']:.1e} got {case['achieved']:.1e} {verdict(case)} time "
            f"est {case['estimated_seconds']:.3g} got {case['seconds']:.3g} s, {case['rung']}, "
            f"{case['superpixels'][0]}x{case['superpixels'][1]} ring {case['coherent_ring']} mem "
            f"est {case['estimated_bytes'] / 2**20:.0f} got {case['bytes'] / 2**20:.0f} MiB"
        )
        + "".join(
            (
                f"; {o['rung']} {o['estimated_seconds']:.3g} got {o['seconds']:.3g} s, "
                f"{o['achieved']:.1e}"
            )
            for o in case["others"]
        )
        + (
            f" (reference {case['reference_change']:.0e})"
            if case["reference_change"] > 0.1 * case["achieved"]
            else ""
        )
    )


def summary(cases):
    """Counts over the cases: how many hold, how honest the estimates are, how often the choice
    was near the fastest.
    """
    done = [c for c in cases if "achieved" in c]

    def share(test, among=done):
        return round(sum(map(test, among)) / len(among), 3) if among else None

    solid = [c for c in done if c["reference_change"] < 0.3 * c["achieved"]]
    return {
        "cases": len(cases),
        "computed": len(done),
        **{word: sum(verdict(c) == word for c in done) for word in ("held", "open", "missed")},
        "refused": sum("refused" in c for c in cases),
        "not run": sum("not_run" in c for c in cases),
        "failed": sum("failed" in c for c in cases),
        "error within [0.1, 10]": share(
            lambda c: 0.1 <= c["estimated_error"] / max(c["achieved"], 1e-300) <= 10, solid
        ),
        "time within [0.5, 2]": share(lambda c: 0.5 <= c["estimated_seconds"] / c["seconds"] <= 2),
        "choice within 1.5": share(lambda c: c["regret"] <= 1.5),
        "worst choice": round(max((c["regret"] for c in done), default=1), 2),
    }


def markdown(cases):
    """Camera by accuracy, a table a suite, and the counts."""
    lines = []
    for model, scope in SUITES:
        some = [c for c in cases if (c["model"], c["scope"]) == (model, scope)]
        if not some:
            continue
        asked = sorted({c["accuracy"] for c in some}, reverse=True)
        lines += [
            (
                f"**{'Paraxial model' if model == 'fresnel' else 'Against the exact model'}, "
                f"{'isolated lenslets' if scope == 'isolated' else 'with coherent neighbours'}**"
            ),
            "",
            "| camera | " + " | ".join(f"{a:.0e}" for a in asked) + " |",
            "|---" * (len(asked) + 1) + "|",
        ]
        for name in dict.fromkeys(c["camera"] for c in some):
            row = {c["accuracy"]: c for c in some if c["camera"] == name}
            lines.append(
                f"| {name} | " + " | ".join(_cell(row[a]) if a in row else "" for a in asked) + " |"
            )
        lines.append("")
    totals = {
        f"{m}, {s}": summary([c for c in cases if (c["model"], c["scope"]) == (m, s)])
        for m, s in SUITES
    }
    totals = {k: v for k, v in totals.items() if v["cases"]} | {"all": summary(cases)}
    words = list(totals["all"])
    lines += ["| suite | " + " | ".join(words) + " |", "|---" * (len(words) + 1) + "|"]
    lines += [
        f"| {suite} | "
        + " | ".join("" if values[w] is None else str(values[w]) for w in words)
        + " |"
        for suite, values in totals.items()
    ]
    return "\n".join(lines) + "\n"


def _cell(case):
    if "achieved" not in case:
        return (
            "refused"
            if "refused" in case
            else f"({case['not_run'].replace('estimated ', '')})"
            if "not_run" in case
            else "FAILED"
        )
    letter = {"rays": "R", "fresnel, low rank": "F", "fresnel, triple product": "T"}.get(
        case["rung"], "E"
    )
    mark = {"held": "", "open": " ?", "missed": " **missed**"}[verdict(case)]
    return (
        f"{case['achieved']:.0e}{mark}, "
        f"{case['seconds']:{'.0f' if case['seconds'] >= 10 else '.2g'}} s {letter}"
    )


def plot(cases, path):
    """Asked against achieved, and time against accuracy, one colour a camera."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5), constrained_layout=True)
    for index, name in enumerate(dict.fromkeys(c["camera"] for c in cases)):
        label = name
        for model, scope in SUITES:
            done = [
                c
                for c in cases
                if (c["camera"], c["model"], c["scope"]) == (name, model, scope) and "achieved" in c
            ]
            style = ("o" if scope == "neighbours" else "x") + ("-" if model == "auto" else ":")
            asked = [c["accuracy"] for c in done]
            left.loglog(
                asked,
                [c["achieved"] for c in done],
                style,
                color=f"C{index}",
                label=label,
                ms=4,
                lw=0.8,
            )
            right.loglog(
                asked, [c["seconds"] for c in done], style, color=f"C{index}", ms=4, lw=0.8
            )
            label = None
    left.plot([1e-8, 1e-1], [1e-8, 1e-1], "k-", lw=0.8)
    left.set(
        xlabel="accuracy asked for",
        ylabel="relative error achieved, worst column",
        title="circles: with neighbours; solid: against the exact model",
    )
    right.set(xlabel="accuracy asked for", ylabel="CPU time of one core (s)")
    left.legend(fontsize=7)
    figure.savefig(path, dpi=130, metadata={"Software": None})
    plt.close(figure)


def write(run, cases):
    """The results so far."""
    kept = [
        {k: v for k, v in c.items() if not k.startswith("_")}
        for c in cases
        if any(w in c for w in ("achieved", "refused", "not_run", "failed"))
    ]
    (run / "tradeoff.json").write_text(
        json.dumps({"summary": summary(kept), "cases": kept}, indent=1) + "\n"
    )
    (run / "tradeoff.md").write_text(markdown(kept))
    plot(kept, run / "tradeoff.png")


def main():
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--run", default="runs/tradeoff", help="folder of the results and of what is kept"
    )
    parser.add_argument(
        "--camera", action="append", choices=list(CAMERAS), help="only this camera (repeatable)"
    )
    parser.add_argument(
        "--accuracy", action="append", type=float, help="only this accuracy (repeatable)"
    )
    parser.add_argument(
        "--model",
        action="append",
        choices=["fresnel", "auto"],
        help="fresnel: within that model; auto: against the exact one (default: both)",
    )
    parser.add_argument(
        "--scope",
        action="append",
        choices=["isolated", "neighbours"],
        help="one lenslet alone, or neighbours as the dial finds right (default: both)",
    )
    parser.add_argument(
        "--budget",
        type=float,
        default=30.0,
        help="matrices estimated to take more seconds than this are not run",
    )
    parser.add_argument(
        "--no-race", action="store_true", help="do not time the other rungs that might serve"
    )
    parser.add_argument("--plan", action="store_true", help="only say what would be run")
    parser.add_argument("--table", action="store_true", help="only tabulate what is kept")
    options = parser.parse_args()
    run = ROOT / options.run
    run.mkdir(parents=True, exist_ok=True)
    cases = [
        plan_case(model, scope, name, accuracy)
        for model, scope in SUITES
        if model in (options.model or [model]) and scope in (options.scope or [scope])
        for name in options.camera or CAMERAS
        for accuracy in options.accuracy or ACCURACIES
    ]
    for case in cases:
        if "refused" not in case and dial.seconds_here(case["_chosen"]) > options.budget:
            case["not_run"] = f"estimated {dial.seconds_here(case['_chosen']):.0f} s"
    todo = sorted(
        (c for c in cases if "refused" not in c and "not_run" not in c),
        key=lambda c: dial.seconds_here(c["_chosen"]),
    )
    matrices, sums = expected(run, todo, options.budget)
    print(
        (
            f"{len(cases)} cases: {sum('refused' in c for c in cases)} refused, "
            f"{sum('not_run' in c for c in cases)} above the budget, {len(todo)} to do; about "
            f"{matrices:.0f} s for matrices and {sums:.0f} s for brute-force columns that are not "
            "at hand, of one core"
        ),
        flush=True,
    )
    if options.plan:
        return
    for number, case in enumerate(todo):
        case |= run_case(run, case, options.budget, not options.no_race, options.table)
        print(line(case), flush=True)
        if number % 20 == 19 and not options.table:
            write(run, cases)
    write(run, cases)
    print(markdown([c for c in cases]).split("\n\n")[-1] if cases else "")


if __name__ == "__main__":
    main()
