"""Coverage-guided fuzzing of the readers: nothing but plenocli's own errors may come out,
within 10 s and 2 GiB.

Run from the project's root (extra [fuzz], `make fuzz`): python tests/faults/fuzz.py --seconds 600
--run runs/fuzz Each reader gets an equal share of the time in a process of its own, which starts
from the small files of the fault tests; what breaks one stays in RUN. Exit 1 where anything did.
"""

import argparse
import hashlib
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
LIMITS = [
    "-timeout=10",
    "-rss_limit_mb=2048",
    "-max_len=60000",
    "-len_control=0",
    "-print_final_stats=1",
    "-verbosity=0",
]


def artefact(path, data):
    """Files as they come: the digest is in the way."""
    from plenocli.files.artefacts.reading import read_artefact

    path.write_bytes(data)
    read_artefact(path)


def sealed(path, data):
    """Files of someone who knows how to make a digest: links, filters, sizes and tables are all
    there is against them.
    """
    from plenocli.files.artefacts.container import HEADER_BYTES, MAGIC
    from plenocli.files.artefacts.reading import read_artefact

    image = data[HEADER_BYTES:]
    head = MAGIC + f"sha256 {hashlib.sha256(image).hexdigest()}\nbytes {len(image)}\n".encode()
    path.write_bytes(head.ljust(HEADER_BYTES, b"\0") + image)
    read_artefact(path)


def exr(path, data):
    from plenocli.files.images.exr import read_exr

    path.write_bytes(data)
    read_exr(path)


def photograph(path, data):
    from plenocli.files.images.pictures import read_picture

    path.write_bytes(data)
    read_picture(path)


def notes(path, data):
    from plenocli.files.images.dng import read_notes

    path.write_bytes(data)
    read_notes(path)


def description(path, data):
    """TOML of cameras, scenes, sweeps and lenses."""
    from plenocli.base.errors import PlenoError
    from plenocli.files.config.camera_file import load_camera
    from plenocli.files.config.lens_file import load_lens
    from plenocli.files.config.scene_file import load_scene
    from plenocli.files.config.sweep_file import load_sweep, points

    path.write_bytes(data)
    for load in (load_camera, load_scene, load_lens):
        try:
            load(path)
        except PlenoError:
            pass
    sweep, axes = load_sweep(path)
    points(sweep, axes)


def score(path, data):
    from plenocli.files.results.scores import read_scores

    path.write_bytes(data)
    read_scores(path)


READERS = {
    "artefact": (artefact, ("*.h5",)),
    "sealed": (
        sealed,
        (
            "capture.h5",
            "score*.h5",
            "spectra.h5",
            "shards.h5",
            "image.h5",
            "predicted.h5",
            "sweep.h5",
        ),
    ),
    "exr": (exr, ("*.exr",)),
    "photograph": (photograph, ("photo.*",)),
    "notes": (notes, ("*.dng",)),
    "description": (description, ("*.toml",)),
    "score": (score, ("*.json",)),
}


def work(name, arguments):
    """Fuzz one reader; libFuzzer ends the process."""
    import atheris

    with atheris.instrument_imports(include=["plenocli", "json", "tomllib"]):
        import plenocli.files.artefacts.container
        import plenocli.files.config.lens_file
        import plenocli.files.config.scene_file
        import plenocli.files.config.sweep_file
        import plenocli.files.images.dng
        import plenocli.files.images.exr
        import plenocli.files.images.pictures
        import plenocli.files.results.run_folder  # noqa: F401
    from plenocli.base.errors import PlenoError

    read, path = (
        READERS[name][0],
        Path(tempfile.mkdtemp(dir="/dev/shm" if os.path.isdir("/dev/shm") else None)) / "input",
    )

    def once(data):
        try:
            read(path, data)
        except PlenoError as error:
            assert str(path) in str(error) or path.name in str(error) or "\n" in str(error), (
                f"the file is not named: {error}"
            )

    atheris.Setup([sys.argv[0], *arguments], once)
    atheris.Fuzz()


def main():
    """Share the time among the readers, then say what was tried and found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, default=Path("runs/fuzz"))
    parser.add_argument("--seconds", type=int, default=600)
    parser.add_argument("--reader", choices=READERS, action="append", help="only these")
    options = parser.parse_args()
    from tests.faults.conftest import make_all
    from tests.faults.harness import Runner

    options.run.mkdir(parents=True, exist_ok=True)
    names, found = options.reader or list(READERS), 0
    with tempfile.TemporaryDirectory() as base:
        samples = Path(base) / "samples"
        with Runner() as runner:
            make_all(samples, runner)
        for name in names:
            corpus, kept = Path(base) / name, options.run / name
            corpus.mkdir()
            kept.mkdir(exist_ok=True)
            for path in (p for pattern in READERS[name][1] for p in samples.glob(pattern)):
                (corpus / path.name).write_bytes(path.read_bytes())
            command = [
                sys.executable,
                __file__,
                "--work",
                name,
                str(corpus),
                f"-max_total_time={options.seconds // len(names)}",
                f"-artifact_prefix={kept}/",
                *LIMITS,
            ]
            done = subprocess.run(
                command,
                capture_output=True,
                text=True,
                errors="replace",
                env=os.environ | {"OMP_NUM_THREADS": "1"},
            )
            (kept / "log.txt").write_text(done.stdout + done.stderr)
            tried = re.search(r"number_of_executed_units:\s+(\d+)", done.stderr)
            broken = sorted(p.name for p in kept.iterdir() if p.name != "log.txt")
            found += len(broken) + (done.returncode != 0 and not broken)
            print(
                (
                    f"{name}: {tried[1] if tried else 'unknown'} files tried, "
                    f"{len(list(corpus.iterdir()))} that reach something new, "
                    f"{', '.join(broken) or 'nothing'} found, exit {done.returncode}"
                ),
                flush=True,
            )
    sys.exit(found > 0)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--work"]:
        work(sys.argv[2], sys.argv[3:])
    else:
        main()
