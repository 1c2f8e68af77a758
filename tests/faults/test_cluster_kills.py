"""kill -9 of client, worker or scheduler of a sweep on Dask: its table is absent or whole, and
the same command run again gives the bytes of an uninterrupted run, and nothing is left.

`make kills` does 400 of each.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.faults.harness import tree

pytest.importorskip("distributed")
pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
SWEEP = """
camera = "camera.toml"
[vary]
"main_lens.f_number" = [6, 7, 8, 9]
[simulate-pif]
model = "ray"
superpixels = "1x1"
[reconstruct]
method = "block-mean"
"""


class Cluster:
    """A scheduler and two workers, each of which may be killed and is then started anew."""

    def __init__(self, folder):
        self.folder, self.address = folder, folder / "scheduler.json"
        self.environment = os.environ | {
            "OMP_NUM_THREADS": "1",
            "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
        }
        self.scheduler, self.workers = None, []

    def start(self, *words):
        with open(self.folder / "dask.log", "ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "dask", *words, "--no-dashboard"]
                + ["--scheduler-file", str(self.address)],
                stdout=log,
                stderr=log,
                env=self.environment,
                cwd=self.folder,
                start_new_session=True,
            )

    def ready(self):
        """Start what is not there; return when it serves."""
        from distributed import Client

        if self.scheduler is None or self.scheduler.poll() is not None:
            self.end(*self.workers)
            self.workers = []
            self.address.unlink(missing_ok=True)
            self.scheduler = self.start("scheduler", "--host", "127.0.0.1", "--port", "0")
            deadline = time.monotonic() + 120
            while not self.address.exists() or not self.address.read_text().endswith("}"):
                assert time.monotonic() < deadline
                time.sleep(0.05)
        self.workers = [w for w in self.workers if w.poll() is None]
        while len(self.workers) < 2:
            words = ("--nthreads", "1", "--no-nanny", "--local-directory", str(self.folder))
            self.workers.append(self.start("worker", *words))
        with Client(scheduler_file=str(self.address), set_as_default=False) as client:
            client.wait_for_workers(2, timeout=120)

    @staticmethod
    def end(*processes):
        for process in processes:
            if process is not None and process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()

    def sweep(self, folder):
        return subprocess.Popen(
            [sys.executable, "-m", "plenocli", "sweep", "sweep.toml", "--overwrite"]
            + ["--scheduler", str(self.address), "-o", "out/w.h5"],
            cwd=folder,
            env=self.environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )


@pytest.fixture
def cluster(tmp_path):
    made = Cluster(tmp_path)
    yield made
    made.end(made.scheduler, *made.workers)


@pytest.mark.filterwarnings("default")  # what Dask's own threads warn of is not ours
@pytest.mark.parametrize("victim", ["client", "worker", "scheduler"])
def test_a_sweep_whose_cluster_is_killed(cluster, tmp_path, campaign, count, victim):
    work = tmp_path / "work"
    (work / "out").mkdir(parents=True)
    (work / "camera.toml").write_text((ROOT / "sample_configs" / "tiny.toml").read_text())
    (work / "sweep.toml").write_text(SWEEP)
    cluster.ready()
    start = time.monotonic()
    process = cluster.sweep(work)
    assert process.wait(timeout=300) == 0, process.stderr.read()
    usual, whole = time.monotonic() - start, tree(work / "out")
    rng, killed, finished = np.random.default_rng(len(victim)), 0, 0
    wanted = int(os.environ.get("KILLS", campaign(1, 5)))
    while killed < wanted and finished < 3 * wanted + 20:
        for path in sorted((work / "out").rglob("*"), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        cluster.ready()
        process = cluster.sweep(work)
        try:
            process.wait(timeout=rng.uniform(0.1, 1) * usual)
            finished += 1
        except subprocess.TimeoutExpired:
            cluster.end(
                {"client": process, "worker": cluster.workers[0], "scheduler": cluster.scheduler}[
                    victim
                ]
            )
            killed += 1
        code = process.wait(timeout=300)
        said = process.stderr.read().decode()
        assert "internal error" not in said and "Traceback" not in said, said
        allowed = {"client": (-signal.SIGKILL, 0), "worker": (0,), "scheduler": (0, 2, 4)}
        assert code in allowed[victim], (code, said)
        left = {name: data for name, data in tree(work / "out").items() if name in whole}
        assert all(whole[name] == data for name, data in left.items())
        cluster.ready()
        process = cluster.sweep(work)
        assert process.wait(timeout=300) == 0, process.stderr.read()
        assert tree(work / "out") == whole
    count(f"kill -9 of a {victim} on Dask", killed=killed, finished_before=finished, other_bytes=0)
