"""The tiling of a plane by lenslets."""

import numpy as np

from plenocli.base.tiling import to_blocks, to_plane


def test_blocks_are_what_stands_in_the_plane_and_go_back():
    plane = np.arange(6 * 20).reshape(6, 20)
    blocks = to_blocks(plane, (2, 5))
    assert blocks.shape == (3, 4, 10)
    for row in range(3):
        for column in range(4):
            assert (
                blocks[row, column].tolist()
                == plane[2 * row : 2 * row + 2, 5 * column : 5 * column + 5].ravel().tolist()
            )
    assert (to_plane(blocks, (2, 5)) == plane).all()
    assert (to_plane(blocks.reshape(3, 4, 2, 5), (2, 5)) == plane).all()


def test_bands_stand_one_after_the_other():
    cube = np.arange(3 * 6 * 20).reshape(3, 6, 20)
    blocks = to_blocks(cube, (2, 5))
    assert blocks.shape == (3, 4, 30) and (blocks[..., 10:20] == to_blocks(cube[1], (2, 5))).all()
    assert (to_plane(blocks, (2, 5)) == cube).all()
