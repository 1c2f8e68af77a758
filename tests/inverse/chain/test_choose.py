"""The choice of a chain: against brute force over tables of losses, and the rehearsal that makes
such a table against the stages run one by one.
"""

import itertools
import json

import numpy as np
import pytest

from plenocli.cli.main import run
from plenocli.files.read.cameras import read_camera
from plenocli.inverse.chain.chains import INVERSIONS, Chain, MatrixOption, matrix_options
from plenocli.inverse.chain.choose import MARGIN, PART, PROBE, choose


class Table:
    """Stands for a Rehearsal whose pictures have the PSNR of a table; counts what it was asked."""

    noise, lenslets = 1e-2, 25

    def __init__(self, psnr):
        self.table, self.asked = psnr, {}

    @property
    def runs(self):
        return len(self.asked)

    def psnr(self, matrix, method):
        key = matrix, method
        self.asked[key] = np.array([self.table[key], self.table[key]])
        return self.asked[key]

    def known(self, matrix, method):
        return self.asked.get((matrix, method))


def drawn(rng, spread):
    """(chains by cost, table): losses of matrix and method that add up but for `spread` dB."""
    matrices = [
        MatrixOption(model="exact", accuracy=a, superpixels=(n, n), plan=None)
        for n, a in itertools.product((1, 3), (1e-1, 1e-2, 1e-3))
    ]
    by_matrix = {m: 3.0 * (m.own_only) + rng.exponential(0.3) * m.accuracy for m in matrices}
    by_method = {i: rng.exponential(0.5) for i in INVERSIONS}
    table = {
        (m, i): 30
        - (by_method[i] if i == "block-mean" else by_matrix[m] + by_method[i])
        + rng.uniform(-spread, spread)
        for m in matrices
        for i in INVERSIONS
    }
    chains = [Chain(matrix=m, method=i, seconds=rng.exponential(1.0), bytes=0) for m, i in table]
    return sorted(chains, key=lambda c: c.seconds), table


@pytest.mark.parametrize("allowed", [0.1, 0.3, 1.0])
def test_the_choice_is_the_cheapest_that_brute_force_finds(allowed):
    """Where losses add up nearly: every chain's loss is looked at by brute force. The margin is
    kept, and what is cheaper than the choice loses more.
    """
    rng, asked, known = np.random.default_rng(5), 0, 0
    for _ in range(60):
        chains, table = drawn(rng, 0.02)
        rehearsal = Table(table)
        plan = choose(chains, rehearsal, allowed)
        top = max(table[c.matrix, c.method] for c in chains)
        lost = {c: top - table[c.matrix, c.method] for c in chains}
        limit = (1 - PART) * allowed - MARGIN
        assert lost[plan.best.chain] <= 0.1, "the best but for what does not add up"
        if plan.chosen is not plan.best:
            assert lost[plan.chosen.chain] <= limit + 0.1
        cheaper = [c for c in chains if c.seconds < plan.chosen.chain.seconds]
        # without neighbours only the finest matrix is looked at where it loses far too much
        assert all(lost[c] > limit - 1e-9 for c in cheaper if not c.matrix.own_only)
        asked, known = asked + rehearsal.runs, known + len(chains)
    assert asked < 0.6 * known, "few of all chains are rehearsed"


def test_the_best_chain_serves_where_nothing_cheaper_does():
    chains, table = drawn(np.random.default_rng(1), 0.0)
    plan = choose(chains, Table(table), 1e-3)
    assert plan.chosen is plan.best and plan.chosen.loss == 0


CAMERA = """
[main_lens]
focal_length = "50 mm"
f_number = 8
[object]
distance = "550 mm"
samples_per_lenslet = [8, 8]
[lenslet_array]
distance = "55 mm"
superpixel_pitch = "18 um"
focal_length = "144 um"
count = [5, 5]
[sensor]
distance = "144 um"
pixel_pitch = "2 um"
pixels_per_lenslet = [9, 9]
[light]
wavelengths = ["550 nm"]
"""


def test_losses_are_those_of_the_stages_and_the_commands_run(tmp_path, monkeypatch, capsys):
    """plan's losses against three chains carried out by the commands that it prints, of a capture
    by the exact model, three times as fine, with other noise: the choice's to 0.25 dB, and that
    without the neighbours' light more than 1 dB is lost.
    """
    monkeypatch.chdir(tmp_path)
    (tmp_path / "camera.toml").write_text(CAMERA)
    asked = "plan camera.toml --scene skimage:astronaut --snr 30dB --quality-loss 0.5dB".split()
    assert run(["--quiet", *asked, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    capture = "capture-sim camera.toml --scene skimage:astronaut --snr 30dB --refine 3 --seed 7 "
    capture += "--model exact --superpixels 3x3 --accuracy 1e-3 -o capture.h5"
    assert run(["--quiet", *capture.split()]) == 0

    def db(chain, name):
        shape = "x".join(map(str, chain["superpixels"]))
        lines = [
            f"simulate-pif camera.toml --model {chain['model']} --accuracy {chain['accuracy']:g} "
            f"--superpixels {shape} -o {name}-pif.h5",
            f"reconstruct capture.h5 --pif {name}-pif.h5 --method {chain['method']} -o {name}.h5",
            f"score {name}.h5 --truth capture.h5 -o {name}.json",
        ]
        assert not any(run(["--quiet", *line.split()]) for line in lines)
        return json.loads((tmp_path / f"{name}.json").read_text())["results"][0]["metrics"][
            "psnr_db"
        ]

    best = next(c for c in told["chains"] if c["best"])
    chosen = next(c for c in told["chains"] if c["chosen"])
    alone = next(
        c
        for c in told["chains"]
        if c["superpixels"] == [1, 1] and c["method"] == PROBE and c["rehearsed"]
    )
    top = db(best, "best")
    assert top - db(chosen, "chosen") == pytest.approx(chosen["loss_db"], abs=0.25)
    assert min(top - db(alone, "alone"), alone["loss_db"]) > 1.0, "the neighbours' light counts"
    assert chosen["loss_db"] <= 0.5 and chosen["seconds"] <= best["seconds"]
    capsys.readouterr()
    assert not any(run(["--quiet", *line.split()[1:]]) for line in told["commands"])
    assert (tmp_path / "image.h5").is_file()


def test_matrices_that_reconstruct_would_replace_are_no_choice():
    """At 60 dB the paraxial model is off by more than the noise, at 20 dB by less."""
    from plenocli.api import sample

    camera = read_camera(sample("tiny.toml"))
    assert {m.model for m in matrix_options(camera, 1e-3)} == {"exact"}
    loud = matrix_options(camera, 1e-1)
    assert {"fresnel", "exact"} <= {m.model for m in loud}
    assert {m.superpixels for m in loud} == {(1, 1), (3, 3)}
    assert min(m.accuracy for m in loud) > min(m.accuracy for m in matrix_options(camera, 1e-3))


def test_spectral_cameras_are_refused_in_words_that_help(capsys):
    from plenocli.api import sample

    words = ["plan", str(sample("demo_spectral.toml")), "--scene", "skimage:astronaut"]
    assert run([*words, "--quality-loss", "0.1dB"]) == 2
    said = capsys.readouterr().err
    assert "pictures of one band" in said and "trade_spectral.toml" in said
    assert run(["plan", str(sample("tiny.toml")), "--scene", "x", "--quality-loss", "-1dB"]) == 2
