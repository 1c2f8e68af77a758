"""Filters for a task, designed for a given processing and together with it: two searches, designs
of both fronts captured and scored, one picture and one table.

python pipelines/codesign.py --run runs/codesign --trials 300
"""

import argparse
import csv
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
SWEEPS = ROOT / "sample_configs" / "sweeps"
SEARCHES = {"codesign_optics": "optics alone", "codesign": "optics and processing"}
ACCURACY, EXPOSURE = "class_accuracy_expected", "sensor.exposure"
CAPTURED = """camera = {camera}
chain = "joint"
design = "list"
[simulate-pif]
model = "ray"
accuracy = 1e-2
superpixels = "3x3"
[score]
classes = {classes}
[demux]
{demux}
[front]
class_accuracy = "max"
exposure_s = "min"
"""


def plenocli(*words: str | Path) -> None:
    """Run a command of plenocli; ends this run where it fails."""
    found = subprocess.run([sys.executable, "-m", "plenocli", *map(str, words)], check=False)
    if found.returncode:
        sys.exit(found.returncode)


def rows_of(table: Path) -> list[dict[str, str]]:
    """Rows of a sweep's CSV."""
    with table.with_suffix(".csv").open() as file:
        return list(csv.DictReader(file))


def value(text: str) -> object:
    """What a cell of the CSV stands for in a sweep file."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def seconds(text: str) -> float:
    """An exposure time."""
    from plenocli.base.units import parse_duration

    return parse_duration(text)


def front_of(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """The designs that no other beats, the shortest exposure first."""
    return sorted((r for r in rows if r["front"] == "1"), key=lambda r: seconds(r[EXPOSURE]))


def capture(name: str, run: Path, count: int, workers: int) -> list[dict[str, str]]:
    """Designs of a front, evenly spread over it, captured, demultiplexed and scored."""
    found = front_of(rows_of(run / f"{name}.h5"))
    some = [found[i] for i in np.unique(np.linspace(0, len(found) - 1, count).round().astype(int))]
    sweep = tomllib.loads((SWEEPS / f"{name}.toml").read_text())
    given = dict(sweep.get("demux", {}))
    if "prior" in given:
        given["prior"] = str((SWEEPS / given["prior"]).resolve())
    text = CAPTURED.format(
        camera=json.dumps(str((SWEEPS / sweep["camera"]).resolve())),
        classes=json.dumps(str((SWEEPS / sweep["score"]["classes"]).resolve())),
        demux="\n".join(f"{k} = {json.dumps(v)}" for k, v in given.items()),
    )
    for row in some:
        cells = "\n".join(
            f'"{key}" = {json.dumps(value(row[key]))}' for key in sweep["vary"] if row[key]
        )
        text += f"[[point]]\n{cells}\n"
    path = run / f"{name}_captured.toml"
    path.write_text(text)
    table = path.with_suffix(".h5")
    plenocli("sweep", path, "-o", table, "--workers", workers, "--overwrite")
    return [
        {**shown, ACCURACY: row[ACCURACY]}
        for row, shown in zip(some, rows_of(table), strict=True)
        if shown["status"] == "0"
    ]


def draw(run: Path, captured: dict[str, list[dict[str, str]]]) -> None:
    """Both fronts over the exposure time, and what was captured with its intervals."""
    from plenocli.report.drawing import COLOURS, drawing

    with drawing(6.4, 4.2) as made:
        axes = made.figure.subplots()
        for colour, (name, label) in zip(COLOURS, SEARCHES.items()):
            front = front_of(rows_of(run / f"{name}.h5"))
            times = [1e3 * seconds(row[EXPOSURE]) for row in front]
            share = [float(row[ACCURACY]) for row in front]
            axes.step(times, share, where="post", color=colour, label=f"{label}, expected")
            shown = captured[name]
            middle = np.array([float(row["class_accuracy"]) for row in shown])
            ends = [[float(row[f"class_accuracy_{e}"]) for row in shown] for e in ("low", "high")]
            axes.errorbar(
                [1e3 * float(row["exposure_s"]) for row in shown],
                middle,
                np.abs(np.array(ends) - middle),
                fmt="o",
                color=colour,
                label=f"{label}, captured",
            )
        axes.set(xscale="log", xlabel="exposure (ms)", ylabel="share told rightly", ylim=(0, 1))
        axes.set_xticks([0.2, 0.5, 1, 2, 5, 10, 20], minor=False)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.legend(loc="lower right")
    (run / "codesign.png").write_bytes(made.png)


def lines(captured: list[dict[str, str]]) -> list[str]:
    """A table of the designs that were captured, within 100 characters."""
    keys = (EXPOSURE, "filter_array.layout", "filter_array.filters.*.fwhm")
    figures = (ACCURACY, "class_accuracy", "class_accuracy_low", "class_accuracy_high")
    rows = [("exposure", "layout", "width", "method", "learnt", "expected", "told", "low", "high")]
    for row in captured:
        how = [row.get(key, "") for key in (*keys, "demux.method", "score.learnt")]
        shown = [f"{float(row[c]):.3f}" if row.get(c) else "-" for c in figures]
        rows.append((*how, *shown))
    widths = [max(map(len, column)) for column in zip(*rows)]
    return ["  " + "  ".join(c.rjust(w) for c, w in zip(row, widths)) for row in rows]


def main() -> None:
    """Both searches, captures of their fronts, the picture and the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("runs/codesign"))
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--designs", type=int, default=8, help="of each front that are captured")
    parser.add_argument("--workers", type=int, default=1)
    asked = parser.parse_args()
    asked.run.mkdir(parents=True, exist_ok=True)
    captured = {}
    for name in SEARCHES:
        table = asked.run / f"{name}.h5"
        words = ("--trials", asked.trials, "--workers", asked.workers, "--overwrite")
        plenocli("optimise", SWEEPS / f"{name}.toml", "-o", table, *words)
        captured[name] = capture(name, asked.run, asked.designs, asked.workers)
    draw(asked.run, captured)
    for name, label in SEARCHES.items():
        print(f"{label}; all figures in {asked.run / f'{name}_captured.csv'}")
        print("\n".join(lines(captured[name])))


if __name__ == "__main__":
    main()
