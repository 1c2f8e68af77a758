"""Stages with the same seed draw numbers that have nothing to do with each other."""

import ast
import itertools
from pathlib import Path

import numpy as np

from plenocli.base.random_streams import stream

PACKAGE = Path(__file__).resolve().parents[2] / "plenocli"


def stage_names():
    """The names under which the package draws: the second argument of every call of `stream`."""
    calls = [
        node
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "stream"
    ]
    return [node.args[1].value for node in calls if isinstance(node.args[1], ast.Constant)]


def test_every_stage_draws_under_a_name_of_its_own_and_not_otherwise():
    names = stage_names()
    assert len(names) >= 3 and len(set(names)) == len(names)
    makers = {
        path.name
        for path in PACKAGE.rglob("*.py")
        if "default_rng" in path.read_text() or "RandomState" in path.read_text()
    }
    # the others draw by fixed keys of their own, or only to sketch
    assert makers == {
        "random_streams.py",
        "dictionary.py",
        "sweep_file.py",
        "complex_matrices.py",
        "low_rank_product.py",
    }


def test_streams_of_one_seed_are_uncorrelated_and_so_are_those_of_neighbouring_seeds(count):
    size = 1_000_000
    keys = [
        *((7, name, 0) for name in stage_names()),
        (7, "capture-sim", 1),
        (8, "capture-sim", 0),
        (2**63 - 1, "capture-sim", 0),
        (0, "capture-sim", 0),
    ]
    draws = {key: stream(*key).standard_normal(size) for key in keys}
    # as solvers.dictionary draws
    draws["dictionary"] = np.random.default_rng([7, 0]).standard_normal(size)
    pairs = list(itertools.combinations(draws, 2))
    worst = max(abs(float(np.dot(draws[a], draws[b]))) / np.sqrt(size) for a, b in pairs)
    shifted = max(abs(float(np.dot(draws[a][1:], draws[b][:-1]))) / np.sqrt(size) for a, b in pairs)
    assert max(worst, shifted) < 5  # standard errors
    # the same stream is seen
    assert abs(np.dot(draws[keys[0]], stream(*keys[0]).standard_normal(size))) / np.sqrt(size) > 900
    count("random streams, correlation of pairs", pairs=2 * len(pairs), correlated=0)
