"""One and two workers of a Dask cluster on this machine: captures a second that reconstruct gets through, and the bytes.

python pipelines/benchmarks/cluster.py --run runs/bench-cluster [--config sample_configs/seed_spatial.toml] [--captures 4] [--rounds 2]

Two clusters, one with a single worker, take turns after a round that warms them (each worker factors the matrix once). CPU time is
that of the workers: where other programs want the cores too, it says more than the clock.
"""

import argparse
import hashlib
import os
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path

METHOD = ["--method", "nnls", "--nnls-iterations", "300"]


def plenocli(*arguments):
    subprocess.run([sys.executable, "-m", "plenocli", *map(str, arguments)], check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})


class Cluster:
    """A scheduler and `count` workers of one thread each, as processes."""

    def __init__(self, folder, count):
        self.known, self.processes = folder / f"scheduler-{count}.json", []
        self.known.unlink(missing_ok=True)
        self._start("scheduler", "--host", "127.0.0.1", "--port", "0")
        for _ in range(count):
            self._start("worker", "--nthreads", "1", "--no-nanny", "--local-directory", str(folder))
        from distributed import Client

        while not self.known.exists() or not self.known.read_text():
            time.sleep(0.1)
        with Client(scheduler_file=str(self.known), set_as_default=False) as client:
            client.wait_for_workers(count)

    def _start(self, *arguments):
        command = [sys.executable, "-m", "dask", *arguments, "--no-dashboard", "--scheduler-file", str(self.known)]
        self.processes.append(subprocess.Popen(command, env=os.environ | {"OMP_NUM_THREADS": "1"}, stderr=subprocess.DEVNULL, start_new_session=True))

    def cpu(self):
        """CPU seconds of the workers so far."""
        ticks = os.sysconf("SC_CLK_TCK")
        return sum(sum(map(int, Path(f"/proc/{p.pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13])) for p in self.processes[1:]) / ticks

    def close(self):
        for process in self.processes:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--run", type=Path, default=Path("runs/bench-cluster"))
    parser.add_argument("--config", default="sample_configs/seed_spatial.toml")
    parser.add_argument("--captures", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=2)
    options = parser.parse_args()
    run = options.run.resolve()
    run.mkdir(parents=True, exist_ok=True)
    pif, captures = run / "pif.h5", [run / f"capture{i}.h5" for i in range(options.captures)]
    if not pif.exists():
        plenocli("simulate-pif", options.config, "--model", "fresnel", "--superpixels", "1x1", "--coherent-ring", "0", "--accuracy", "1e-5", "-o", pif)
    for seed, capture in enumerate(captures):
        if not capture.exists():
            plenocli("capture-sim", options.config, "--pif", pif, "--scene", "skimage:astronaut", "--snr", "60dB", "--seed", seed, "-o", capture)

    clusters, wall, cpu, bytes_of = {n: Cluster(run, n) for n in (1, 2)}, {1: [], 2: []}, {1: [], 2: []}, set()
    try:
        for round_ in range(options.rounds + 1):
            for n in (1, 2) if round_ % 2 else (2, 1):
                start, spent, out = time.monotonic(), clusters[n].cpu(), run / f"pictures-{n}"
                plenocli("reconstruct", *captures, "--pif", pif, *METHOD, "--scheduler", clusters[n].known, "--overwrite", "-o", out)
                bytes_of.add(hashlib.sha256(b"".join(p.read_bytes() for p in sorted(out.iterdir()))).hexdigest())
                if round_:
                    wall[n].append(time.monotonic() - start)
                    cpu[n].append(clusters[n].cpu() - spent)
                    print(f"{n} worker(s): {wall[n][-1]:.1f} s, CPU {cpu[n][-1]:.1f} s, load {os.getloadavg()[0]:.1f}", flush=True)
    finally:
        for cluster in clusters.values():
            cluster.close()
    medians = {n: statistics.median(wall[n]) for n in wall}
    print(f"{options.captures} captures: {medians[1]:.1f} s with one worker, {medians[2]:.1f} s with two: {medians[1] / medians[2]:.2f} times the throughput; "
          f"CPU of two over one {statistics.median(cpu[2]) / statistics.median(cpu[1]):.2f}; bytes {'the same' if len(bytes_of) == 1 else 'DIFFER'}")


if __name__ == "__main__":
    main()
