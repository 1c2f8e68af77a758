"""Linear maps with a forward and an adjoint side by side; the spaces they join carry names."""

from plenocli.operators.maps import BlockToeplitz, Dense, LinearMap, Space, adjoint_gap

__all__ = ["BlockToeplitz", "Dense", "LinearMap", "Space", "adjoint_gap"]
