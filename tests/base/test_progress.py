"""Bars that nobody sees go over what they are given all the same."""

import numpy as np

from plenocli.base.progress import bar, collected_notes


def test_a_silent_bar_takes_arrays_and_nothing():
    with collected_notes():
        assert list(bar(np.array([4e-7, 5e-7]))) == [4e-7, 5e-7]
        assert list(bar([])) == [] and list(bar(None, 3)) == []
