"""What the joint LMMSE of plenocli.solvers.overlap does where its statistics are not quite a covariance."""

import numpy as np

from plenocli.solvers.overlap import _factor


def test_a_covariance_that_dips_below_zero_has_a_factor():
    """A cut autocovariance is none: Cholesky alone would refuse it."""
    rng = np.random.default_rng(5)
    basis = np.linalg.qr(rng.standard_normal((40, 40)))[0]
    values = np.geomspace(1e-6, 1, 40)
    good = (basis * values) @ basis.T
    np.testing.assert_allclose(_factor(good, 1e-6), np.linalg.cholesky(good), rtol=1e-6, atol=1e-12)
    values[:3] = -3e-6, -1e-9, 0
    factor = _factor((basis * values) @ basis.T, 1e-6)
    assert (np.triu(factor, 1) == 0).all()
    np.testing.assert_allclose(np.sort(np.linalg.eigvalsh(factor @ factor.T))[:3], [1e-6, 1e-6, values[3]], rtol=1e-5)
    np.testing.assert_allclose(basis.T @ factor @ factor.T @ basis, np.diag(np.maximum(np.abs(values), 1e-6)), atol=1e-12)
