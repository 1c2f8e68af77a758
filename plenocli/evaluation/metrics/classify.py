"""Which patch of a chart is it? How often spectra tell, by a trained classifier and by the
nearest known spectrum.
"""

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


def samples(cube, labels):
    """Spectra (n, band) and labels (n,) of the labelled lenslets of a cube (band, row, column)
    that have values in all bands.
    """
    spectra = np.moveaxis(np.asarray(cube, dtype=np.float64), 0, -1)
    keep = (labels > 0) & np.isfinite(spectra).all(axis=-1)
    return spectra[keep], np.asarray(labels)[keep]


def cross_validated(spectra, labels, folds=FOLDS):
    """Share of samples named rightly by a linear discriminant analysis that has not seen them, or
    None: fewer than two patches of two lenslets. Patches with one lenslet are left out. Folds are
    drawn with a fixed seed. ImportError without scikit-learn.
    """
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
    from sklearn.model_selection import StratifiedKFold, cross_val_predict
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    names, where, counts = np.unique(labels, return_inverse=True, return_counts=True)
    keep = counts[where] >= 2
    if (counts >= 2).sum() < 2:
        return None
    folds = StratifiedKFold(
        min(folds, int(counts[counts >= 2].min())), shuffle=True, random_state=0
    )
    classifier = make_pipeline(
        StandardScaler(), LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto")
    )
    said = cross_val_predict(classifier, spectra[keep], labels[keep], cv=folds)
    return float(np.mean(said == labels[keep]))


def nearest_known(spectra, labels, known):
    """Share of samples whose nearest spectrum among `known` (label -> (band,)) is that
    of their own label.
    """
    names = np.array(list(known))
    distance = np.linalg.norm(
        spectra[:, None] - np.array([known[name] for name in names])[None], axis=-1
    )
    return float(np.mean(names[distance.argmin(axis=1)] == labels))
