"""The dictionary step of Algorithm 1 (Berkner et al. 2013, Fig. 4): atoms that give clean patches
back from their codes.

min (1/B)|X - Phi C|^2 + delta |A Phi|^2 in closed form, and the published gradient steps beside it;
docs/model.md, "Spatial reconstruction".
"""

import numpy as np

from plenocli.inverse.sparse.coherence import INVISIBLE


def moments(patches: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the dictionary step needs of patches and their codes.

    patches: (point, patch) X.
    c: (atom, patch) C.

    Returns (C C^T / B (atom, atom), X C^T / B (point, atom)) of B patches.
    """
    return c @ c.T / patches.shape[1], patches @ c.T / patches.shape[1]


def dictionary_step(
    energy: np.ndarray, basis: np.ndarray, gram: np.ndarray, right: np.ndarray, delta: float
) -> tuple[np.ndarray, float]:
    """The minimum of (1/B)|X - Phi C|^2 + delta |A Phi|^2, in closed form.

    Its normal equations are the Sylvester equation delta Q Phi + Phi (G + e I) = R with Q = A^T A =
    basis diag(energy) basis^T, and a ridge e = 1e-6 tr(G) / atoms that keeps it solvable where
    atoms are not used.

    energy: (k,) eigenvalues of Q.
    basis: (point, k) its eigenvectors; directions of no energy may be left out.
    gram: (atom, atom) G = C C^T / B.
    right: (point, atom) R = X C^T / B.
    delta: weight of what the sensor sees.

    Returns (Phi (point, atom), |left - right|_F / |R|_F of the normal equations).
    Raises NumericsError where that residual is above 1e-8.
    """
    from scipy.linalg import eigh  # five times faster at 1600 atoms than numpy's

    from plenocli.base.errors import NumericsError

    ridge = ridge_of(gram)
    use, directions = eigh(gram, driver="evd")
    use = np.maximum(use, 0) + ridge
    turned = right @ directions
    inside = basis.T @ turned
    atoms = (
        turned / use + basis @ (inside / (delta * energy[:, None] + use) - inside / use)
    ) @ directions.T
    residual = _normal_residual(energy, basis, gram, right, delta, atoms)
    if not residual <= 1e-8:
        raise NumericsError(
            f"the dictionary step solves its equations only to {residual:.1e}",
            fix="use a larger --batch or another --delta",
        )
    return atoms, residual


def gradient_step(
    energy: np.ndarray,
    basis: np.ndarray,
    gram: np.ndarray,
    right: np.ndarray,
    delta: float,
    atoms: np.ndarray,
    steps: int,
) -> tuple[np.ndarray, float]:
    """The published dictionary step: down the gradient 2 (Phi (G + e I) - R + delta Q Phi).

    Step length 1 / (2 (largest eigenvalue of G + e + delta times that of Q)), the largest that is
    safe; Nesterov's momentum.

    energy, basis, gram, right, delta: as of `dictionary_step`.
    atoms: (point, atom) to begin with.
    steps: number of steps.

    Returns (Phi (point, atom), relative residual, which says how far from the minimum they end).
    Berkner et al. 2013, Fig. 4.
    """
    ridge = ridge_of(gram)
    length = 1 / (np.linalg.norm(gram, 2) + ridge + delta * energy.max())
    ahead, momentum = atoms, 1.0
    for _ in range(steps):
        pull = delta * (basis @ (energy[:, None] * (basis.T @ ahead))) if delta else 0.0
        stepped = ahead - length * (ahead @ gram + ridge * ahead - right + pull)
        after = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        ahead = stepped + (momentum - 1) / after * (stepped - atoms)
        atoms, momentum = stepped, after
    return atoms, _normal_residual(energy, basis, gram, right, delta, atoms)


def pulled(
    gram: np.ndarray, right: np.ndarray, atoms: np.ndarray, batches: float
) -> tuple[np.ndarray, np.ndarray]:
    """G and R of the dictionary step with w |Phi - atoms|^2 added to what it makes least.

    Few patches use an atom: what one batch says of it is mostly noise. w is the median power of a
    coefficient times `batches`, so that to a typical atom its past is worth so many batches.

    gram: (atom, atom) G.
    right: (point, atom) R.
    atoms: (point, atom) before the step.
    batches: 0 for none.
    """
    weight = batches * float(np.median(np.diag(gram)))
    return gram + weight * np.eye(len(gram)), right + weight * atoms


def decorrelated(seen: np.ndarray, atoms: np.ndarray, share: float) -> np.ndarray:
    """Atoms one step down the gradient of the sum of squared cosines of what the sensor sees of
    two of them, |U^T U - I|^2 with U the unit columns of A Phi.

    The step mixes atoms and leaves their number and span as they are: U (I - share (U^T U - I) /
    |U|^2), which for share up to 1 takes no correlation beyond its opposite. Invisible atoms stay.

    seen: (row, point) A.
    atoms: (point, atom).
    share: 0 for none.

    Returns (point, atom).
    """
    visible, unit, norm = _visible(seen @ atoms)
    if not share or not visible.any():
        return atoms
    gram = unit.T @ unit
    largest = np.linalg.norm(unit @ unit.T if len(unit) < len(gram) else gram, 2)
    mix = np.eye(len(gram)) - share / largest * (gram - np.eye(len(gram)))
    mixed = atoms.copy()
    mixed[:, visible] = (atoms[:, visible] / norm) @ mix * norm
    return mixed


def _visible(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(which columns are more than INVISIBLE of the largest, those at unit norm, their norms)."""
    norm = np.linalg.norm(columns, axis=0)
    visible = norm > INVISIBLE * norm.max(initial=0)
    return visible, columns[:, visible] / norm[visible], norm[visible]


def ridge_of(gram: np.ndarray) -> float:
    """e of the dictionary step of G (atom, atom): keeps it solvable where atoms are unused."""
    return max(1e-6 * np.trace(gram) / len(gram), np.finfo(float).tiny)


def _normal_residual(
    energy: np.ndarray,
    basis: np.ndarray,
    gram: np.ndarray,
    right: np.ndarray,
    delta: float,
    atoms: np.ndarray,
) -> float:
    """|delta Q Phi + Phi (G + e I) - R|_F / |R|_F."""
    left = atoms @ gram + ridge_of(gram) * atoms
    if delta:
        left += delta * (basis @ (energy[:, None] * (basis.T @ atoms)))
    return float(np.linalg.norm(left - right) / max(np.linalg.norm(right), np.finfo(float).tiny))
