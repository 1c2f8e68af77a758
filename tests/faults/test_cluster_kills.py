"""kill -9 of client, worker or scheduler of a sweep on Dask: its table is absent or whole, and
the same command run again gives the bytes of an uninterrupted run, and nothing is left.

Forked from a warm process by the hundred, and a few of the real programs.
"""

import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from tests.faults.forked import Forks, Programs
from tests.faults.harness import tree

pytest.importorskip("distributed")
pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
SWEEP = """
camera = "camera.toml"
[vary]
"main_lens.f_number" = [6, 7]
[simulate-pif]
model = "ray"
superpixels = "1x1"
[reconstruct]
method = "block-mean"
"""


class Cluster:
    """A scheduler and two workers, each of which may be killed and is then started anew."""

    def __init__(self, source, folder):
        self.source, self.folder, self.address = source, folder, folder / "scheduler.json"
        self.scheduler, self.workers = None, []

    def ready(self):
        """Start what is not there."""
        if self.scheduler is None or self.scheduler.ended():
            self.end()
            self.address.unlink(missing_ok=True)
            self.scheduler = self.source.start("scheduler", [self.address], self.folder)
            deadline = time.monotonic() + 120
            while not self.address.exists() or not self.address.read_text().endswith("}"):
                assert time.monotonic() < deadline
                time.sleep(0.01)
        self.workers = [w for w in self.workers if not w.ended()]
        while len(self.workers) < 2:
            self.workers.append(self.source.start("worker", [self.address], self.folder))

    def end(self):
        for process in (self.scheduler, *self.workers):
            if process is not None and not process.ended():
                process.kill()
        self.workers = []

    def sweep(self, folder):
        words = ["sweep", "sweep.toml", "--overwrite", "--scheduler", self.address]
        return self.source.start("plenocli", [*words, "-o", "out/w.h5"], folder)


@pytest.mark.filterwarnings("default")  # what Dask's own threads warn of is not ours
@pytest.mark.parametrize("kind", [Forks, Programs])
@pytest.mark.parametrize("victim", ["client", "worker", "scheduler"])
def test_a_sweep_whose_cluster_is_killed(tmp_path, campaign, count, victim, kind):
    work, wanted = tmp_path / "work", campaign(2, 400 if kind is Forks else 2)
    (work / "out").mkdir(parents=True)
    (work / "camera.toml").write_text((ROOT / "sample_configs" / "tiny.toml").read_text())
    (work / "sweep.toml").write_text(SWEEP)
    with kind(tmp_path) as source:
        cluster = Cluster(source, tmp_path)
        try:
            cluster.ready()
            assert cluster.sweep(work).code(300) == 0
            start, whole = time.monotonic(), tree(work / "out")
            empty(work / "out")
            assert cluster.sweep(work).code(300) == 0 and tree(work / "out") == whole
            usual, rng, killed, finished = time.monotonic() - start, seed_of(victim), 0, 0
            while killed < wanted or not whole.keys() <= tree(work / "out").keys():
                if whole.keys() <= tree(work / "out").keys():
                    empty(work / "out")
                cluster.ready()
                process = cluster.sweep(work)
                if killed < wanted and not process.ended(rng.uniform(0.05, 0.9) * usual):
                    {
                        "client": process,
                        "worker": cluster.workers[0],
                        "scheduler": cluster.scheduler,
                    }[victim].kill()
                    killed += 1
                else:
                    finished += 1
                assert finished < 2 * wanted + 20
                code = None if victim == "client" and process.ended() else process.code(300)
                allowed = {"client": (None, 0), "worker": (0,), "scheduler": (0, 2, 4)}
                assert code in allowed[victim], code
                left = tree(work / "out")
                assert all(left.get(name, data) == data for name, data in whole.items())
            assert tree(work / "out") == whole
        finally:
            cluster.end()
    said = (tmp_path / "plenocli.log").read_text()
    assert "internal error" not in said and "Traceback" not in said, said[-3000:]
    how = "forked" if kind is Forks else "real"
    count(f"kill -9 of a {how} {victim} on Dask", killed=killed, other_bytes=0)


def seed_of(text):
    return np.random.default_rng(list(text.encode()))


def empty(folder):
    shutil.rmtree(folder)
    folder.mkdir()
