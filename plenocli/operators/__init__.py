"""Linear maps with a forward and an adjoint side by side; the spaces they join carry names. And the tiling of planes by lenslets."""

from plenocli.operators.maps import BlockToeplitz, Dense, LinearMap, Space, adjoint_gap
from plenocli.operators.tiling import to_blocks, to_plane

__all__ = ["BlockToeplitz", "Dense", "LinearMap", "Space", "adjoint_gap", "to_blocks", "to_plane"]
