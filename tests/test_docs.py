"""Every command line of the README and of docs, run as it stands and in the order of its page, by
bash in a folder of a new user.

What is run: fenced blocks marked `sh`. The files that the pages name as the reader's own, the
cameras and sweeps of sample_configs, and the number of trials of the longest search, are small
ones here.
"""

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from plenocli.cli.main import run

ROOT = Path(__file__).resolve().parents[1]
PAGES = ["README.md", *sorted(f"docs/{p.name}" for p in (ROOT / "docs").glob("*.md"))]
BLOCKS = {
    page: re.findall(r"^```sh\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), re.S | re.M)
    for page in PAGES
}
NEEDS = {
    "lens import": "optiland",
    "dask ": "distributed",
    "optimise": "optuna",
    "codesign": "optuna",
}
"""Words of a block -> the module of an extra without which it cannot run."""
SMALL = {
    "[20, 20]": "[12, 12]",
    '"80 um"': '"48 um"',
    '"640 um"': '"384 um"',
    "samples_per_lenslet = [10, 10]": "samples_per_lenslet = [2, 2]",
}
SWEEPS = {
    "lenslets": {
        "[5.6, 8, 11, 16]": "[5.6, 8]",
        "[[9, 9], [11, 11], [13, 13], [15, 15], [17, 17]]": "[[9, 9]]",
        "steps = 5": "steps = 2",
    },
    "trade": {
        "demo_spatial": "tiny",
        '["ray", "fresnel", "exact"]': '["ray", "fresnel"]',
        '["block-mean", "tikhonov", "lmmse", "pnp"]': '["block-mean", "lmmse"]',
        "[1e-1, 1e-2, 1e-3]": "[1e-1]",
        '["1x1", "3x3"]': '["3x3"]',
    },
    "trade_iterations": {
        "demo_spatial": "tiny",
        "[1e-1, 1e-2, 1e-3]": "[1e-1]",
        "[10, 30, 100, 300, 1000]": "[10, 30]",
    },
    "trade_spectral": {
        "demo_spectral": "seed_spectral",
        '["5 nm", "20 nm", "50 nm"]': '["50 nm"]',
        '["single-pixel", "pinv", "wls"]': '["single-pixel", "pinv"]',
        "accuracy = 1e-3": "accuracy = 1e-2",
        '"10 nm"': '"50 nm"',
    },
    **dict.fromkeys(
        ("codesign", "codesign_optics"), {"[[2, 2], [2, 3], [3, 3], [3, 4], [4, 4]]": "[[2, 2]]"}
    ),
    "trade_depth": {"[5, 9, 13, 25, 49]": "[5, 9]", '["500 mm", "550 mm", "620 mm"]': '["500 mm"]'},
}
"""Sweeps of sample_configs/sweeps -> what is smaller here."""
MONOCHROME = {
    '"311.112 um"': '"309.6 um"',
    "[16, 16]": "[6, 6]",
    "[18, 25]": "[12, 14]",
    '"12.9 um"': '"25.8 um"',
    "[24, 24]": "[12, 12]",
}
"""What is smaller of the camera that docs/photographer.md describes."""
VOLUME = {
    "[6, 6]": "[4, 4]",
    "[object]\n": '[object]\nplanes = "490 mm to 504 mm step 7 mm"\n',
}
SHORT = {"--trials 200": "--trials 4"}


def rewritten(text, changes):
    for old, new in changes.items():
        assert old in text, old
        text = text.replace(old, new)
    return text


def _microscope_files(folder):
    """microscope.toml and TIFFs of a light field, a fluorescent slide and a dark frame."""
    from PIL import Image

    from plenocli.files.images.mosaic import read_capture

    small = {
        '"-12 um to 12 um step 1 um"': '"-2 um to 2 um step 1 um"',
        "count = [29, 29]": "count = [12, 13]",
        "samples_per_lenslet = [3, 3]": "samples_per_lenslet = [2, 2]",
    }
    text = rewritten((ROOT / "sample_configs" / "microscope.toml").read_text(), small)
    (folder / "microscope.toml").write_text(text)
    (folder / "sample_configs" / "microscope.toml").write_text(text)
    for name, phantom in (("radiometry", "slide"), ("light_field", "filaments")):
        made = folder / f"{name}.dng"
        line = ["capture-sim", str(folder / "microscope.toml"), "--volume", f"phantom:{phantom}"]
        assert run([*line, "--accuracy", "0.05", "-o", str(made)]) == 0
        mosaic = read_capture(made).mosaic.astype(np.uint16)
        Image.fromarray(mosaic + 100).save(folder / f"{name}.tif")
        made.unlink()
    noise = np.random.default_rng(7).integers(98, 103, mosaic.shape)
    Image.fromarray(noise.astype(np.uint16)).save(folder / "dark.tif")


@pytest.fixture(scope="session")
def kit(tmp_path_factory):
    """A folder with what the pages suppose: descriptions, photographs, RAW files of a small
    camera with four filters, a run to report.
    """
    from PIL import Image
    from skimage import data

    from plenocli.files.images.mosaic import read_capture
    from tests.reference.chart import paint_folder

    folder = tmp_path_factory.mktemp("kit")
    shutil.copytree(ROOT / "sample_configs", folder / "sample_configs")
    tiny, spectral = (
        (ROOT / "sample_configs" / f"{name}.toml").read_text() for name in ("tiny", "demo_spectral")
    )
    spectral = rewritten(spectral, SMALL)
    for name, text in {
        "seed_spatial": tiny,
        "seed_spatial_250um": tiny,
        "seed_spectral": spectral,
        "dslr": spectral.replace(
            "bits = 12", 'bits = 12\ncfa = "RGGB"\ncamera = "Nikon 5100 (NPL)"'
        ).replace("quantum_efficiency = 0.55\n", ""),
    }.items():
        (folder / "sample_configs" / f"{name}.toml").write_text(text)
    for name, changes in SWEEPS.items():
        sweep = folder / "sample_configs" / "sweeps" / f"{name}.toml"
        sweep.write_text(rewritten(sweep.read_text(), changes))
    shutil.copytree(ROOT / "pipelines", folder / "pipelines")
    (folder / "camera.toml").write_text(spectral)

    (folder / "photos").mkdir()
    Image.fromarray(data.astronaut()).save(folder / "photo.png")
    near = np.full((60, 60, 4), 200, np.uint8)
    near[:, 30:, 3] = 0
    Image.fromarray(near).save(folder / "near.png")
    for name in ("camera", "coffee", "chelsea", "coins"):
        Image.fromarray(getattr(data, name)()).save(folder / "photos" / f"{name}.jpg", quality=95)

    (folder / "captures").mkdir()
    # grey: colours before filters are no even light, of which a grid is found without a white image
    Image.fromarray(data.astronaut()).convert("L").save(folder / "a.png")
    Image.fromarray(data.coffee()).convert("L").save(folder / "b.png")
    shots = {
        "white": ["--target", "white"],
        "dark": ["--target", "dark"],
        "captures/chart": ["--target", "colorchecker"],
        "captures/a": ["--scene", str(folder / "a.png")],
        "captures/b": ["--scene", str(folder / "b.png")],
        **{f"b{nm}": ["--target", f"mono:{nm}nm"] for nm in (450, 540, 570, 650)},
    }
    for seed, (name, what) in enumerate(shots.items()):
        made = folder / f"{name}.dng"
        assert (
            run(
                [
                    "capture-sim",
                    str(folder / "camera.toml"),
                    *what,
                    "--model",
                    "fresnel",
                    "--accuracy",
                    "1e-2",
                    "--superpixels",
                    "1x1",
                    "--seed",
                    str(seed),
                    "-o",
                    str(made),
                ]
            )
            == 0
        )
        made.rename(made.with_suffix(".nef"))
    for name in "ab":
        (folder / f"{name}.png").unlink()
    shutil.copy(folder / "captures" / "a.nef", folder / "capture.nef")
    Image.fromarray(read_capture(folder / "capture.nef").mosaic.astype(np.uint16)).save(
        folder / "lightfield.png"
    )

    _microscope_files(folder)
    chart = folder / "chart"
    chart.mkdir()
    paint_folder(chart)
    (folder / "triplet.zmx").write_text(ZMX)
    _made_before(folder, folder / "of_a_page" / "explore")
    _monochrome_files(folder, folder / "of_a_page" / "photographer")
    (folder / "runs" / "spatial").mkdir(parents=True)
    shutil.copy(folder / "of_a_page" / "explore" / "pif.h5", folder / "runs" / "spatial")
    (folder / "Makefile").write_text(
        "raw trade:\n\t$(MAKE) -f pipelines/$@.mk RUN=runs/$@\n.PHONY: raw trade\n"
    )
    return folder


def _monochrome_files(folder, made):
    """The camera without colours that the page describes, its planes, and PNGs of it."""
    from PIL import Image

    from plenocli.files.images.mosaic import read_capture

    (made / "captures").mkdir(parents=True)
    page = (ROOT / "docs" / "photographer.md").read_text(encoding="utf-8")
    (camera,) = re.findall(r"^```toml\n(.*?)^```", page, re.S | re.M)
    camera = rewritten(camera, MONOCHROME)
    (made / "camera.toml").write_text(camera)
    (made / "planes.toml").write_text(rewritten(camera, VOLUME))
    shots = {
        "white": ["--target", "white"],
        "dark": ["--target", "dark"],
        "captures/a": ["--scene", str(folder / "photo.png")],
    }
    for seed, (name, what) in enumerate(shots.items()):
        raw = made / f"{name}.dng"
        line = ["capture-sim", str(made / "camera.toml"), *what, "--model", "fresnel"]
        line += ["--accuracy", "1e-2", "--superpixels", "1x1", "--seed", str(seed)]
        assert run([*line, "-o", str(raw)]) == 0
        Image.fromarray(read_capture(raw).mosaic.astype(np.uint16)).save(made / f"{name}.png")
        raw.unlink()


def _made_before(folder, made):
    """What the other pages made, for the one that goes on from there."""
    (made / "captures").mkdir(parents=True)
    bands = [
        word for nm in (450, 540, 570, 650) for word in ("--band", f"{nm}nm={folder}/b{nm}.nef")
    ]
    assert (
        run(
            [
                "calibrate",
                "--white",
                str(folder / "white.nef"),
                "--dark",
                str(folder / "dark.nef"),
                *bands,
                "-o",
                str(made / "calibration.h5"),
            ]
        )
        == 0
    )
    pif, camera = str(made / "pif.h5"), str(folder / "sample_configs" / "tiny.toml")
    assert run(["simulate-pif", camera, "--model", "ray", "--superpixels", "1x1", "-o", pif]) == 0
    for seed, name in enumerate(("capture", "captures/one", "captures/two")):
        assert (
            run(
                [
                    "capture-sim",
                    camera,
                    "--pif",
                    pif,
                    "--scene",
                    "skimage:coins",
                    "--snr",
                    "50dB",
                    "--seed",
                    str(seed),
                    "-o",
                    str(made / f"{name}.h5"),
                ]
            )
            == 0
        )


ZMX = """VERS 140124 258 36214
MODE SEQ
UNIT MM X W X CM MR CPMM
ENPD 10
WAVM 1 0.55 1
PWAV 1
SURF 0
  CURV 0.0 0 0 0 0
  DISZ INFINITY
SURF 1
  STOP
  CURV 0.02 0 0 0 0
  DISZ 4
  GLAS N-BK7 0 0 1.5168 64.17 0 0 0 0 0 0
  DIAM 8 1 0 0 1
SURF 2
  CURV -0.02 0 0 0 0
  DISZ 47
  DIAM 8 1 0 0 1
SURF 3
  CURV 0.0 0 0 0 0
  DISZ 0
"""


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return str(one.getsockname()[1])


def bash(script, folder, timeout):
    """(exit code, what was printed) of a script; what it left running in the
    background is ended.
    """
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MAKE")} | {
        "PATH": path,
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONPATH": str(ROOT),
    }
    with open(folder / "log", "w+") as log:
        child = subprocess.Popen(
            ["bash", "-euo", "pipefail", "-x", "-c", script],
            cwd=folder,
            env=environment,
            stdout=log,
            stderr=log,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            child.wait(timeout=timeout)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.wait()
        log.seek(0)
        return child.returncode, log.read()


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if BLOCKS[page]])
def test_the_page_runs_as_it_stands(kit, tmp_path, page):
    folder = tmp_path / "user"
    shutil.copytree(kit, folder, ignore=shutil.ignore_patterns("of_a_page"))
    own = kit / "of_a_page" / Path(page).stem
    if own.exists():
        shutil.copytree(own, folder, dirs_exist_ok=True)
    blocks, left = [], []
    for block in BLOCKS[page]:
        missing = [
            module
            for words, module in NEEDS.items()
            if words in block and find_spec(module) is None
        ]
        (left if missing else blocks).append((block, missing))
    script = "".join(block for block, _ in blocks).replace("8786", free_port())
    for long, short in SHORT.items():
        script = script.replace(long, short)
    code, log = bash(script, folder, 900)
    assert code == 0, log[-3000:]
    if left:
        pytest.skip(
            "without "
            + ", ".join(sorted({m for _, missing in left for m in missing}))
            + f" these were not run: {[block for block, _ in left]}"
        )


def test_command_lines_stand_in_blocks_that_are_run():
    """All but the two that make the environment itself (README) and the script
    for a SLURM cluster.
    """
    for page in PAGES:
        text = (ROOT / page).read_text(encoding="utf-8")
        other = [
            block
            for mark, block in re.findall(r"^```(\w*)\n(.*?)^```", text, re.S | re.M)
            if mark != "sh"
        ]
        assert not re.findall(r"^    (?:plenocli|make) [a-z].*", text, re.M), page
        assert {
            line.split("#")[0].strip()
            for block in other
            for line in re.findall(r"^(?:plenocli|make) .*", block, re.M)
        } <= {"make demo", "make test"}, page


def test_the_plan_that_the_page_shows_is_the_plan(monkeypatch, capsys):
    """Its errors and memory; the times are those of some machine."""
    monkeypatch.chdir(ROOT)
    assert run(["simulate-pif", "sample_configs/seed_spatial.toml", "--explain"]) == 0
    printed = capsys.readouterr().out
    (shown,) = re.findall(
        r"^```\n(asked: .*?)^```",
        (ROOT / "docs" / "accuracy.md").read_text(encoding="utf-8"),
        re.S | re.M,
    )
    found, page = (
        [re.sub(r"[\d.]+ s |\s+", " ", line).split() for line in text.splitlines()]
        for text in (printed, shown)
    )
    assert len(page) == 10 and found[:10] == page


def test_the_sweep_that_the_tutorial_writes_is_read(tmp_path):
    from plenocli.cli.sections import read_options
    from plenocli.files.config.sweep_file import points
    from plenocli.stages.sweep.space import open_space

    (tmp_path / "sweeps").mkdir()
    shutil.copy(ROOT / "sample_configs" / "tiny.toml", tmp_path)
    (example,) = re.findall(
        r"^```toml\n(.*?)^```",
        (ROOT / "docs" / "explore.md").read_text(encoding="utf-8"),
        re.S | re.M,
    )
    (tmp_path / "sweeps" / "mine.toml").write_text(example)
    space = open_space(tmp_path / "sweeps" / "mine.toml", read_options, 0)
    rows = [
        space.point(number, point)
        for number, point in enumerate(points(space.sweep, space.axes, 0))
    ]
    assert len(rows) == 4 * 5 * 3 and all(
        row.task is not None and row.result is None for row in rows
    )
