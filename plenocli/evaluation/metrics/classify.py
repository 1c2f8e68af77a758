"""Which patch of a chart is it? How often spectra tell, by a trained classifier and by the
nearest known spectrum.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

DEFINITIONS = {
    "classification_accuracy": (
        "share of lenslets whose patch a linear discriminant analysis names that was trained on "
        "other lenslets (stratified cross-validation, five folds or as many as the smallest patch "
        "has lenslets; scikit-learn)"
    ),
    "nearest_patch_accuracy": (
        "share of lenslets whose spectrum is nearest to the true one of their own patch"
    ),
}
FOLDS = 5
"""Parts of a cross-validation, where the smallest patch has as many lenslets."""


@dataclass(frozen=True)
class ClassificationScore:
    """Shares of lenslets that tell their patch; the trained one is NaN where no patch suffices for
    a training, None without scikit-learn. See DEFINITIONS.
    """

    nearest_patch_accuracy: float
    classification_accuracy: float | None


def score_classification(
    cube: np.ndarray, labels: np.ndarray, known: Mapping[int, np.ndarray]
) -> ClassificationScore | None:
    """How often spectra tell their patch.

    cube: (band, row, column).
    labels: (row, column), 0 for nothing.
    known: label -> (band,) true spectrum.

    Returns None where fewer than two patches are known, or one of those seen is not.
    """
    spectra, patches = samples(cube, labels)
    if len(known) < 2 or not len(patches) or not set(patches) <= set(known):
        return None
    nearest = nearest_known(spectra, patches, known)
    try:
        return ClassificationScore(nearest, cross_validated(spectra, patches))
    except ImportError:
        return ClassificationScore(nearest, None)


def samples(cube: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Labelled lenslets that have values in all bands.

    cube: (band, row, column).
    labels: (row, column), 0 for nothing.

    Returns (spectra (n, band), labels (n,)).
    """
    spectra = np.moveaxis(np.asarray(cube, dtype=np.float64), 0, -1)
    keep = (labels > 0) & np.isfinite(spectra).all(axis=-1)
    return spectra[keep], np.asarray(labels)[keep]


def cross_validated(spectra: np.ndarray, labels: np.ndarray, folds: int = FOLDS) -> float:
    """Share of samples named rightly by a linear discriminant analysis that has not seen them.

    spectra: (n, band).
    labels: (n,); patches with one lenslet are left out.
    folds: parts, drawn with a fixed seed.

    Returns NaN where fewer than two patches have two lenslets.
    Raises ImportError without scikit-learn.
    """
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
    from sklearn.model_selection import StratifiedKFold, cross_val_predict
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    names, where, counts = np.unique(labels, return_inverse=True, return_counts=True)
    keep = counts[where] >= 2
    if (counts >= 2).sum() < 2:
        return np.nan
    parts = StratifiedKFold(
        min(folds, int(counts[counts >= 2].min())), shuffle=True, random_state=0
    )
    classifier = make_pipeline(
        StandardScaler(), LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")
    )
    with warnings.catch_warnings():
        # that a patch of few lenslets leaves one to learn from
        warnings.filterwarnings("ignore", "Only one sample available", UserWarning)
        said = cross_val_predict(classifier, spectra[keep], labels[keep], cv=parts)
    return float(np.mean(said == labels[keep]))


def nearest_known(
    spectra: np.ndarray, labels: np.ndarray, known: Mapping[int, np.ndarray]
) -> float:
    """Share of samples whose nearest known spectrum is that of their own label.

    spectra: (n, band).
    labels: (n,).
    known: label -> (band,).
    """
    names = np.array(list(known))
    distance = np.linalg.norm(
        spectra[:, None] - np.array([known[name] for name in names])[None], axis=-1
    )
    return float(np.mean(names[distance.argmin(axis=1)] == labels))
