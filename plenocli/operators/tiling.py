"""A plane of pixels or object points as blocks, one a lenslet, and back; lenslets tile the plane from its first corner."""


def to_blocks(plane, shape):
    """(row, column) -> (lenslet_row, lenslet_column, sample), samples numbered row by row in blocks of `shape` = (rows, columns).

    Both sides of the plane are whole numbers of blocks.
    """
    rows, columns = plane.shape[0] // shape[0], plane.shape[1] // shape[1]
    return plane.reshape(rows, shape[0], columns, shape[1]).swapaxes(1, 2).reshape(rows, columns, shape[0] * shape[1])


def to_plane(blocks, shape):
    """(lenslet_row, lenslet_column, sample) -> (row, column), the inverse of `to_blocks`.

    Of one axis of samples or of two that stand for it, (..., rows, columns).
    """
    rows, columns = blocks.shape[:2]
    return blocks.reshape(rows, columns, *shape).swapaxes(1, 2).reshape(rows * shape[0], columns * shape[1])
