"""One and two workers of a Dask cluster on this machine: what reconstruct gets through, and whether
the bytes are those of one process.

python pipelines/benchmarks/cluster.py --run runs/bench-cluster [--config
sample_configs/seed_spatial.toml] [--captures 4] [--rounds 2] [--workers 1 2]

Several captures are tasks each; of one capture (--captures 1) batches of its lenslets are. The
method is non-negative least squares with a fixed number of steps. Clusters take turns after a round
that warms them (each worker factors the matrix once); with --rounds 1 there is none. CPU time is
that of the workers: where other programs want the cores too, it says more than the clock. What was
measured is kept in RUN/cluster-N.json for N captures, so that --workers 1 and
--workers 2 may run apart.
"""

import argparse
import hashlib
import json
import os
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path

STEPS = {False: 300, True: 5000}
"""Steps of the solver, by whether there is one capture alone: enough to outweigh the start of a
worker, which factors the matrix.
"""


def plenocli(*arguments):
    subprocess.run(
        [sys.executable, "-m", "plenocli", *map(str, arguments)],
        check=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )


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
        command = [
            sys.executable,
            "-m",
            "dask",
            *arguments,
            "--no-dashboard",
            "--scheduler-file",
            str(self.known),
        ]
        self.processes.append(
            subprocess.Popen(
                command,
                env=os.environ | {"OMP_NUM_THREADS": "1"},
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        )

    def cpu(self):
        """CPU seconds of the workers so far."""
        ticks = os.sysconf("SC_CLK_TCK")
        return (
            sum(
                sum(
                    map(
                        int,
                        Path(f"/proc/{p.pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13],
                    )
                )
                for p in self.processes[1:]
            )
            / ticks
        )

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
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    options = parser.parse_args()
    run = options.run.resolve()
    run.mkdir(parents=True, exist_ok=True)
    pif, captures = run / "pif.h5", [run / f"capture{i}.h5" for i in range(options.captures)]
    if not pif.exists():
        plenocli(
            "simulate-pif",
            options.config,
            "--model",
            "fresnel",
            "--superpixels",
            "1x1",
            "--coherent-ring",
            "0",
            "--accuracy",
            "1e-5",
            "-o",
            pif,
        )
    for seed, capture in enumerate(captures):
        if not capture.exists():
            plenocli(
                "capture-sim",
                options.config,
                "--pif",
                pif,
                "--scene",
                "skimage:astronaut",
                "--snr",
                "60dB",
                "--seed",
                seed,
                "-o",
                capture,
            )

    kept = run / f"cluster-{options.captures}.json"
    known = json.loads(kept.read_text()) if kept.exists() else {"wall": {}, "cpu": {}, "bytes": []}
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # no cluster stays behind
    clusters = {n: Cluster(run, n) for n in options.workers}
    try:
        for round_ in range(options.rounds + (options.rounds > 1)):
            for n in options.workers if round_ % 2 else options.workers[::-1]:
                start, spent, out = (
                    time.monotonic(),
                    clusters[n].cpu(),
                    run / (f"pictures-{n}" if len(captures) > 1 else f"picture-{n}.h5"),
                )
                plenocli(
                    "reconstruct",
                    *captures,
                    "--pif",
                    pif,
                    "--method",
                    "nnls",
                    "--nnls-iterations",
                    STEPS[len(captures) == 1],
                    "--scheduler",
                    clusters[n].known,
                    "--overwrite",
                    "-o",
                    out,
                )
                files = [out / c.name for c in captures] if len(captures) > 1 else [out]
                known["bytes"] = sorted(
                    {
                        *known["bytes"],
                        hashlib.sha256(b"".join(p.read_bytes() for p in files)).hexdigest(),
                    }
                )
                if round_ or options.rounds == 1:
                    known["wall"].setdefault(str(n), []).append(time.monotonic() - start)
                    known["cpu"].setdefault(str(n), []).append(clusters[n].cpu() - spent)
                    print(
                        (
                            f"{n} worker(s): {known['wall'][str(n)][-1]:.1f} s, CPU "
                            f"{known['cpu'][str(n)][-1]:.1f} s, load {os.getloadavg()[0]:.1f}"
                        ),
                        flush=True,
                    )
    finally:
        for cluster in clusters.values():
            cluster.close()
    kept.write_text(json.dumps(known, indent=1))
    wall, cpu = (
        {n: statistics.median(values) for n, values in known[what].items()}
        for what in ("wall", "cpu")
    )
    if len(wall) > 1:
        print(
            f"{options.captures} captures: {wall['1']:.1f} s with one worker, {wall['2']:.1f} s "
            f"with two: {wall['1'] / wall['2']:.2f} times the throughput; CPU of two over one "
            f"{cpu['2'] / cpu['1']:.2f}; bytes "
            f"{'the same' if len(known['bytes']) == 1 else 'DIFFER'}"
        )


if __name__ == "__main__":
    main()
