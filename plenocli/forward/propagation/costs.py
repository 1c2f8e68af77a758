"""What a computation costs: operations in matrix products, seconds of all else, memory."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Cost:
    """What the matrix of one wavelength costs.

    operations: real ones in complex matrix products (8 for a complex multiply-add);
    seconds: of one core for all that does not scale with these;
    bytes: held at once beyond the result.
    """

    operations: float
    seconds: float
    bytes: int
