"""A real Dask scheduler and real workers as processes: the same bytes, one killed in the middle,
versions that differ.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from plenocli.base.errors import UsageError
from plenocli.cli.main import run
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.writing import write_artefact
from plenocli.inverse.picture.methods import per_lenslet
from plenocli.stages.inverse.reconstruct import run as stage

pytest.importorskip("distributed")
pytestmark = pytest.mark.filterwarnings("default")  # what Dask's own threads warn of is not ours

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """(file that tells the address, workers(n) -> the processes of n workers that are there)."""
    from distributed import Client

    folder = tmp_path_factory.mktemp("dask")
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
    }
    known, started = folder / "scheduler.json", []

    def start(*arguments):
        with open(folder / f"{len(started)}.log", "wb") as log:
            started.append(
                subprocess.Popen(
                    [
                        sys.executable,
                        "-m",
                        "dask",
                        *arguments,
                        "--no-dashboard",
                        "--scheduler-file",
                        str(known),
                    ],
                    stdout=log,
                    stderr=log,
                    env=environment,
                    cwd=folder,
                    start_new_session=True,
                )
            )

    def workers(count):
        while len(alive := [p for p in started[1:] if p.poll() is None]) < count:
            start("worker", "--nthreads", "1", "--no-nanny", "--local-directory", str(folder))
        with Client(scheduler_file=str(known), set_as_default=False) as client:
            client.wait_for_workers(count, timeout=120)
        return alive

    start("scheduler", "--host", "127.0.0.1", "--port", "0")
    deadline = time.monotonic() + 120
    while not known.exists() or not known.read_text():
        assert time.monotonic() < deadline and started[0].poll() is None, (
            folder / "0.log"
        ).read_text()
        time.sleep(0.1)
    yield known, workers
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def described(folder):
    text = (ROOT / "sample_configs" / "tiny.toml").read_text()
    for old, new in [
        ("[8, 8]", "[4, 4]"),
        ("[13, 13]", "[9, 9]"),
        ('"26 um"', '"18 um"'),
        ('"208 um"', '"144 um"'),
        ("[5, 5]", "[3, 3]"),
    ]:
        text = text.replace(old, new)
    (folder / "camera.toml").write_text(text)
    (folder / "sweep.toml").write_text(
        'camera = "camera.toml"\n'
        "[vary]\n"
        '"main_lens.f_number" = [5, 7, 9, 0.01]\n'
        '"capture-sim.snr" = ["30 dB", "50 dB"]\n'
        "[simulate-pif]\n"
        'model = "fresnel"\n'
        'superpixels = "1x1"\n'
        "accuracy = 1e-2\n"
        "[reconstruct]\n"
        'method = "tikhonov"\n'
    )
    return folder / "sweep.toml"


def same(table, other):
    return (
        table.read_bytes() == other.read_bytes()
        and table.with_suffix(".csv").read_bytes() == other.with_suffix(".csv").read_bytes()
    )


def capture(path, radiance, seed):
    """Lenslets of 12 x 12 pixels with two bands, one a half, and noise."""
    y, x = np.indices((12, 12)) - 5.5
    edge = np.clip((5.2 - np.abs(y)) / 1.5, 0, 1) * np.clip((5.2 - np.abs(x)) / 1.5, 0, 1)
    response = (
        1000 * edge[..., None] * np.where((x > 0)[..., None] == (np.arange(2) == 1), 0.97, 0.03)
    )
    image = np.einsum("rcb,yxb->rycx", np.broadcast_to(radiance, (9, 9, 2)), response).reshape(
        108, -1
    )
    values = np.rint(100 + image + np.random.default_rng(seed).normal(0, 2.0, image.shape)).astype(
        np.uint16
    )
    attrs = dict(units="DN", black=100.0, white=4095.0, exposure_s=0.1, gain_e_per_dn=4.0)
    write_artefact(
        path,
        Artefact("capture", {"capture/mosaic": values, "capture/cfa": "mono"}, {"capture": attrs}),
    )
    return path


def test_a_cluster_gives_the_same_bytes_and_loses_nothing_with_a_worker(cluster, tmp_path):
    known, workers = cluster
    path = described(tmp_path)
    assert run(["sweep", str(path), "-o", str(tmp_path / "here.h5")]) == 0
    first = workers(2)[0]
    script = (
        f"from plenocli.cli.main import run; raise SystemExit(run(['sweep', {str(path)!r}, "
        f"'--scheduler', {str(known)!r}, '-o', {str(tmp_path / 'there.h5')!r}]))"
    )
    with open(tmp_path / "log", "w") as log:
        child = subprocess.Popen(
            [sys.executable, "-c", script],
            stderr=log,
            stdout=log,
            env={
                **os.environ,
                "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
            },
        )
        kept, deadline = tmp_path / "there.parts" / "points.jsonl", time.monotonic() + 300
        while (
            child.poll() is None
            and time.monotonic() < deadline
            and (not kept.exists() or kept.read_bytes().count(b'"status"') < 2)
        ):
            time.sleep(0.01)
        assert child.poll() is None, "the points were over before anyone could be killed"
        os.killpg(first.pid, signal.SIGKILL)
        first.wait()
        assert child.wait(timeout=300) == 0, (tmp_path / "log").read_text()
    assert same(tmp_path / "there.h5", tmp_path / "here.h5")


def test_captures_go_to_the_cluster_and_come_back_the_same(cluster, tmp_path, monkeypatch):
    known, workers = cluster
    workers(1)
    monkeypatch.chdir(tmp_path)  # names relative to where this process is
    bands = [
        f"{nm}nm={capture(Path(f'b{nm}.h5'), np.eye(2)[k], k)}" for k, nm in enumerate((480, 620))
    ]
    assert (
        run(
            [
                "calibrate",
                "--white",
                str(capture(Path("white.h5"), (1, 1), 0)),
                "--band",
                bands[0],
                "--band",
                bands[1],
                "-o",
                "c.h5",
            ]
        )
        == 0
    )
    described(tmp_path)
    assert (
        run(
            [
                "simulate-pif",
                "camera.toml",
                "--model",
                "fresnel",
                "--superpixels",
                "1x1",
                "-o",
                "pif.h5",
            ]
        )
        == 0
    )
    shots = [str(capture(Path(f"shot{i}.h5"), (0.2 + 0.1 * i, 0.5), 10 + i)) for i in range(4)]
    for i in range(4):
        assert (
            run(
                [
                    "capture-sim",
                    "camera.toml",
                    "--pif",
                    "pif.h5",
                    "--scene",
                    "skimage:coins",
                    "--snr",
                    "50dB",
                    "--seed",
                    str(i),
                    "-o",
                    f"view{i}.h5",
                ]
            )
            == 0
        )
    views = [f"view{i}.h5" for i in range(4)]
    for where, options in {
        "here": [],
        "there": ["--scheduler", str(known)],
        "beside": ["--workers", "2"],
    }.items():
        assert (
            run(
                [
                    "demux",
                    *shots,
                    "--calibration",
                    "c.h5",
                    "--reference",
                    "white.h5",
                    *options,
                    "-o",
                    f"spectra-{where}",
                ]
            )
            == 0
        )
        assert (
            run(
                [
                    "reconstruct",
                    *views,
                    "--pif",
                    "pif.h5",
                    "--method",
                    "lmmse",
                    "--training",
                    "skimage:camera",
                    *options,
                    "-o",
                    f"pictures-{where}",
                ]
            )
            == 0
        )
    for kind in ("spectra", "pictures"):
        for where in ("there", "beside"):
            found = sorted(p for p in Path(f"{kind}-{where}").iterdir() if p.stem != "summary")
            assert len(found) == 4 and all(
                p.read_bytes() == (Path(f"{kind}-here") / p.name).read_bytes() for p in found
            )


@pytest.mark.parametrize(
    "method",
    [
        ["nnls"],
        pytest.param(["nnls", "--nnls-iterations", "30"], marks=pytest.mark.slow),
        pytest.param(["dictionary", "--dictionary", "dictionary.h5"], marks=pytest.mark.slow),
    ],
    ids=["converged", "stopped", "dictionary"],
)
def test_batches_of_the_lenslets_of_one_capture_give_the_bytes_of_one_process(
    cluster, tmp_path, monkeypatch, method
):
    known, workers = cluster
    workers(2)
    monkeypatch.chdir(tmp_path)
    described(tmp_path)
    assert (
        run(
            [
                "simulate-pif",
                "camera.toml",
                "--model",
                "fresnel",
                "--superpixels",
                "1x1",
                "-o",
                "pif.h5",
            ]
        )
        == 0
    )
    assert (
        run(
            [
                "capture-sim",
                "camera.toml",
                "--pif",
                "pif.h5",
                "--scene",
                "skimage:coins",
                "--snr",
                "50dB",
                "-o",
                "view.h5",
            ]
        )
        == 0
    )
    if method[0] == "dictionary":
        assert (
            run(
                [
                    "learn-dict",
                    "skimage:camera",
                    "skimage:brick",
                    "--pif",
                    "pif.h5",
                    "--iterations",
                    "1",
                    "--atoms",
                    "20",
                    "--batch",
                    "60",
                    "-o",
                    "dictionary.h5",
                ]
            )
            == 0
        )
    # nine lenslets: five batches
    for name in ("NNLS_BATCH", "NNLS_CONVERGED_BATCH", "DICTIONARY_BATCH"):
        monkeypatch.setattr(per_lenslet, name, 2)
    sent, noted, send = {}, [], stage.solve_in_pool

    def sending(recipe, pool, solve, batches, options):
        noted.extend(batches)
        return send(recipe, pool, solve, batches, options)

    monkeypatch.setattr(stage, "solve_in_pool", sending)
    asked = ["reconstruct", "view.h5", "--pif", "pif.h5", "--method", *method]
    for name, options in {
        "here": [],
        "there": ["--scheduler", str(known)],
        "beside": ["--workers", "2"],
    }.items():
        noted.clear()
        assert run([*asked, *options, "-o", f"{name}.h5"]) == 0
        sent[name] = len(noted)
    assert sent == {"here": 0, "there": 5, "beside": 5}, (
        "only the two with workers send batches out"
    )
    assert len({Path(f"{name}.h5").read_bytes() for name in ("here", "there", "beside")}) == 1


def test_a_worker_killed_over_a_batch_of_lenslets_loses_nothing(cluster, tmp_path):
    from distributed import Client

    known, workers = cluster
    alive = {p.pid: p for p in workers(2)}
    text = (ROOT / "sample_configs" / "tiny.toml").read_text()
    (tmp_path / "camera.toml").write_text(
        text.replace("[8, 8]", "[14, 14]").replace("[5, 5]", "[8, 8]")
    )
    pif, view = str(tmp_path / "pif.h5"), str(tmp_path / "view.h5")
    assert (
        run(
            [
                "simulate-pif",
                str(tmp_path / "camera.toml"),
                "--model",
                "fresnel",
                "--superpixels",
                "1x1",
                "-o",
                pif,
            ]
        )
        == 0
    )
    assert (
        run(
            [
                "capture-sim",
                str(tmp_path / "camera.toml"),
                "--pif",
                pif,
                "--scene",
                "skimage:coins",
                "--snr",
                "50dB",
                "-o",
                view,
            ]
        )
        == 0
    )
    command = ["reconstruct", view, "--pif", pif, "--method", "nnls"]
    assert run([*command, "-o", str(tmp_path / "here.h5")]) == 0
    with (
        open(tmp_path / "log", "w") as log,
        Client(scheduler_file=str(known), set_as_default=False) as client,
    ):
        child = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "plenocli",
                *command,
                "--scheduler",
                str(known),
                "-o",
                str(tmp_path / "there.h5"),
            ],
            stderr=log,
            stdout=log,
            env={
                **os.environ,
                "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
            },
        )
        busy, deadline = [], time.monotonic() + 120
        while not busy and child.poll() is None and time.monotonic() < deadline:
            pids = client.run(os.getpid)
            busy = [
                pids[address]
                for address, tasks in client.processing().items()
                if tasks and address in pids
            ]
        assert busy, "the batches were over before anyone could be killed"
        os.killpg(busy[0], signal.SIGKILL)
        alive[busy[0]].wait()
        assert child.wait(timeout=300) == 0, (tmp_path / "log").read_text()
    assert (tmp_path / "there.h5").read_bytes() == (tmp_path / "here.h5").read_bytes()


def test_one_capture_and_a_bad_one_on_the_cluster(cluster, tmp_path, capsys):
    known, workers = cluster
    workers(1)
    described(tmp_path)
    pif, view, bad = (str(tmp_path / name) for name in ("pif.h5", "view.h5", "bad.h5"))
    assert (
        run(
            [
                "simulate-pif",
                str(tmp_path / "camera.toml"),
                "--model",
                "fresnel",
                "--superpixels",
                "1x1",
                "-o",
                pif,
            ]
        )
        == 0
    )
    assert (
        run(
            [
                "capture-sim",
                str(tmp_path / "camera.toml"),
                "--pif",
                pif,
                "--scene",
                "skimage:coins",
                "--snr",
                "50dB",
                "-o",
                view,
            ]
        )
        == 0
    )
    for options in ([], ["--scheduler", str(known)]):
        assert (
            run(
                [
                    "reconstruct",
                    view,
                    "--pif",
                    pif,
                    "--method",
                    "tikhonov",
                    *options,
                    "-o",
                    str(tmp_path / f"one{len(options)}.h5"),
                ]
            )
            == 0
        )
    assert (tmp_path / "one0.h5").read_bytes() == (tmp_path / "one2.h5").read_bytes()
    Path(bad).write_bytes(Path(view).read_bytes()[:-30])
    capsys.readouterr()
    assert (
        run(
            [
                "reconstruct",
                view,
                bad,
                "--pif",
                pif,
                "--method",
                "tikhonov",
                "--scheduler",
                str(known),
                "-o",
                str(tmp_path / "several"),
            ]
        )
        == 3
    )
    assert "bad.h5: is truncated" in capsys.readouterr().err and [
        p.name for p in (tmp_path / "several").glob("*.h5")
    ] == ["view.h5"]


def test_a_worker_of_another_version_is_refused(cluster, monkeypatch, tmp_path):
    from plenocli.execution import pool as scheduler

    known, workers = cluster
    workers(1)
    monkeypatch.setattr(scheduler, "__version__", "9.9.9")
    with scheduler.open_pool(1, str(known)) as pool:
        pool.submit("token", len, "abc")
        token, result = pool.next()
    assert token == "token" and isinstance(result, UsageError) and "9.9.9" in str(result)
