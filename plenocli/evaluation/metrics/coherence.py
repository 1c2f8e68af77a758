"""Coherence of a dictionary Phi with the system matrix A: what sparse recovery from y = A
Phi c can hope for.

Three quantities go by the name; all are reported. D = A Phi is the effective dictionary, what the
sensor sees of each atom. See docs/model.md, "Spatial reconstruction".
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from plenocli.base.random_streams import stream
from plenocli.inverse.sparse.coherence import column_coherence

DEFINITIONS = {
    "coherence_raw": (
        "max |<a_i, phi_j>| over rows of A and atoms, nothing normalised (Berkner et al. 2013); "
        "depends on the scale of A"
    ),
    "coherence_candes_romberg": (
        "sqrt(n) max |<a_i, phi_j>| / (|a_i| |phi_j|), n = object points: 1 (incoherent) to "
        "sqrt(n) (Candes and Romberg 2007)"
    ),
    "coherence_effective": (
        "mu(D) = max |<d_i, d_j>| / (|d_i| |d_j|) over pairs of different columns "
        "of D = A Phi: 0 to 1"
    ),
    "coherence_effective_mean": "mean of the same over all pairs",
    "welch_bound": (
        "sqrt((L - M) / (M (L - 1))) for L atoms and M pixels: the least mu(D) "
        "can be; 0 when L <= M"
    ),
    "exact_recovery_sparsity": (
        "largest k < (1 + 1/mu(D)) / 2: any k atoms are recovered exactly without noise "
        "(Donoho and Elad 2003)"
    ),
    "random_candes_romberg": (
        "coherence_candes_romberg of as many random atoms of mean zero, normally distributed"
    ),
    "random_effective_mean": "coherence_effective_mean of the same",
    "dead_atoms": "atoms of zero norm",
    "invisible_atoms": (
        "atoms with |A phi| < 1e-6 of the largest: the sensor cannot tell them from "
        "nothing; left out of mu(D)"
    ),
}


@dataclass(frozen=True, kw_only=True)
class CoherenceScore:
    """Measures of a dictionary with a matrix, NaN where two visible atoms are due and there are
    none, and where no random atoms were asked for. See DEFINITIONS.
    """

    coherence_raw: float
    coherence_candes_romberg: float
    coherence_effective: float
    coherence_effective_mean: float
    welch_bound: float
    exact_recovery_sparsity: float
    dead_atoms: int
    invisible_atoms: int
    atoms: int
    points: int
    pixels: int
    random_candes_romberg: float = math.nan
    random_effective_mean: float = math.nan

    @property
    def mutual(self) -> float:
        """Largest |cosine| between a row of A and an atom: 1/sqrt(n) to 1; the paper asks for one
        far below 1.
        """
        return self.coherence_candes_romberg / math.sqrt(self.points)

    @property
    def random_mutual(self) -> float:
        """The same of random atoms."""
        return self.random_candes_romberg / math.sqrt(self.points)


def dictionary_coherence(system: np.ndarray, atoms: np.ndarray) -> CoherenceScore:
    """Measures of a learnt dictionary, and of random atoms beside them.

    Constant atoms are left out: the sparse code has them for free, and nearly all light is in the
    mean, so that they alone would make any dictionary look coherent.

    system: A (pixel, point).
    atoms: Phi (point, atom).

    Raises ValueError where the points of the two differ.
    """
    atoms = np.asarray(atoms)
    varying = atoms[:, np.ptp(atoms, axis=0) > 1e-6 * np.linalg.norm(atoms, axis=0)]
    found = coherence(system, varying)
    draw = stream(0, "coherence").standard_normal(varying.shape).astype(atoms.dtype)
    draw -= draw.mean(axis=0)
    random = coherence(system, draw / np.linalg.norm(draw, axis=0))
    return replace(
        found,
        random_candes_romberg=random.coherence_candes_romberg,
        random_effective_mean=random.coherence_effective_mean,
    )


def coherence(system: np.ndarray, atoms: np.ndarray, block: int = 512) -> CoherenceScore:
    """Measures of DEFINITIONS, in the precision of the inputs.

    system: A (pixel, point).
    atoms: Phi (point, atom).
    block: columns of products held at a time, beside the inputs and D (pixel, atom).

    Raises ValueError where the points of the two differ.
    docs/model.md, "Spatial reconstruction".
    """
    system, atoms = np.asarray(system), np.asarray(atoms)
    pixels, points = system.shape
    if atoms.ndim != 2 or atoms.shape[0] != points:
        raise ValueError(f"A has {points} object points, the dictionary is {atoms.shape}")
    count = atoms.shape[1]
    row_norm = np.linalg.norm(system, axis=1)
    atom_norm = np.linalg.norm(atoms, axis=0)
    row_scale, atom_scale = (np.where(norm > 0, norm, np.inf) for norm in (row_norm, atom_norm))
    effective = np.empty((pixels, count), dtype=np.result_type(system, atoms))
    raw = candes = 0.0
    for start in range(0, count, block):
        part = slice(start, start + block)
        product = system @ atoms[:, part]
        effective[:, part] = product
        magnitude = np.abs(product)
        raw = max(raw, float(magnitude.max(initial=0)))
        magnitude = magnitude / row_scale[:, None] / atom_scale[part]
        candes = max(candes, float(magnitude.max(initial=0)))
    largest, mean, visible = column_coherence(effective, block)
    return CoherenceScore(
        coherence_raw=raw,
        coherence_candes_romberg=math.sqrt(points) * candes,
        coherence_effective=math.nan if largest is None else largest,
        coherence_effective_mean=math.nan if mean is None else mean,
        welch_bound=welch_bound(count, pixels),
        exact_recovery_sparsity=math.nan if largest is None else exact_recovery_sparsity(largest),
        dead_atoms=int((atom_norm == 0).sum()),
        invisible_atoms=int((~visible & (atom_norm > 0)).sum()),
        atoms=count,
        points=points,
        pixels=pixels,
    )


def welch_bound(atoms: int, pixels: int) -> float:
    """Least possible mutual coherence of `atoms` unit vectors in `pixels` dimensions (Welch
    1974).
    """
    return math.sqrt((atoms - pixels) / (pixels * (atoms - 1))) if atoms > pixels else 0.0


def exact_recovery_sparsity(mu: float) -> float:
    """Largest whole k below (1 + 1/mu)/2; NaN for mu = 0, where no limit follows."""
    return math.nan if mu <= 0 else math.ceil((1 + 1 / mu) / 2 - 1e-12) - 1
