"""Finished tiles beside a result: what is kept is found, by its name and nothing else."""

import numpy as np
import pytest

from plenocli.base.errors import OutputError
from plenocli.base.tiling import FORGETFUL, kept
from plenocli.files.bench import Bench, clear


def test_a_tile_is_made_once_and_each_name_has_its_own(tmp_path):
    bench = Bench.beside(tmp_path / "out.h5", "settings")
    made = []

    def make(values):
        made.append(values)
        return np.float32(values), np.array(True)

    assert not list(tmp_path.iterdir())
    for _ in range(2):
        for keeper, values in ((bench, [1.5, np.nan]), (bench.under("other"), [[0.1]])):
            first, second = kept(keeper, "0-4", lambda values=values: make(values))
            np.testing.assert_array_equal(first, np.float32(values))
            assert second
    assert len(made) == 2
    again = Bench.beside(tmp_path / "out.h5", "settings")
    assert again.folder == bench.folder and again.get("0-4") is not None
    assert again.under("another").get("0-4") is None
    clear(bench.target)
    assert not list(tmp_path.iterdir())
    kept(FORGETFUL.under("other"), "0-4", lambda: make([1.0]))
    kept(FORGETFUL, "0-4", lambda: make([1.0]))
    assert len(made) == 4 and not list(tmp_path.iterdir())


def test_tiles_of_other_settings_go_and_those_of_other_results_stay(tmp_path):
    names = "out.h5", "[ou]t.h5", "out.h5.h5"
    benches = [Bench.beside(tmp_path / name, "settings") for name in names]
    for bench in benches:
        bench.put("tile", [np.ones(3)])
    Bench.beside(tmp_path / "[ou]t.h5", "other settings")
    assert [bench.folder.exists() for bench in benches] == [True, False, True]
    clear(tmp_path / "out.h5")
    assert [bench.folder.exists() for bench in benches] == [False, False, True]


def test_a_folder_that_cannot_be_made_is_an_output_error(tmp_path):
    bench = Bench.beside(tmp_path / "gone" / "out.h5", "settings")
    with pytest.raises(OutputError, match=r"gone/out.h5: the folder of its tiles cannot be made"):
        bench.put(0, [np.ones(2)])
