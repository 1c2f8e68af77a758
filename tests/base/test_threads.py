"""Work on several threads: plenocli.base.budget."""

from dataclasses import replace
from functools import partial

import pytest

from plenocli.base.budget import budget, spread_in_turn, within


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_groups_end_after_their_parts_whoever_takes_them(threads):
    done = []
    groups = [
        ([(group, part) for part in range(3)], partial(done.append, (group, "end")))
        for group in range(4)
    ]
    with within(replace(budget(), threads=threads)):
        spread_in_turn(groups, lambda group, part: done.append((group, part)))
    assert len(done) == 16
    for group in range(4):
        mine = [what for number, what in done if number == group]
        assert sorted(mine[:3]) == [0, 1, 2] and mine[3:] == ["end"]


@pytest.mark.parametrize("threads", [1, 3])
def test_a_part_that_fails_ends_nothing_and_is_told(threads):
    ended = []

    def fail(part):
        if part == 1:
            raise ValueError("part 1")

    with within(replace(budget(), threads=threads)), pytest.raises(ValueError, match="part 1"):
        spread_in_turn([([(0,), (1,), (2,)], lambda: ended.append(0))], fail)
    assert not ended
