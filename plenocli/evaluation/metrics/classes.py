"""Which of a user's own classes is it? Spectra told apart by what is known of the classes and of
the noise, and how often that should succeed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

FOLDS = 5
"""Parts of the lenslets, each judged by classes that were learnt from the others."""
DEFINITIONS = {
    "classes_seen": "classes of --classes that the truth shows",
    "class_accuracy": (
        "share of lenslets that are told to be of the class of the labelled spectrum that the "
        "truth is nearest to: the likeliest of the classes, each normally distributed with the "
        "mean of its spectra and the covariance that all share, with the predicted noise on it; "
        "with --learnt, mean and covariance are those of lenslets that show other spectra, four "
        "fifths of them"
    ),
    "class_accuracy_low": (
        "lower end of its 95 % confidence interval (Wilson 1927), for other spectra of these "
        "classes: lenslets that show the same spectrum count for as many as its own share leaves "
        "them (Korn and Graubard 1998)"
    ),
    "class_accuracy_high": "upper end of its 95 % confidence interval",
    "class_accuracy_predicted": (
        "what class_accuracy is at least expected to be from the classes and the predicted noise "
        "alone: 1 less the sum over the other classes of Phi(-d/2), d their distance in standard "
        "deviations (union bound; exact for two classes)"
    ),
    "detection_auc": (
        "how often a lenslet of the class of --detect looks more like it than one of another class "
        "(area under the receiver operating characteristic) to the linear filter that its mean, "
        "the others' means and covariance and the predicted noise call for"
    ),
    "detection_auc_low": (
        "lower end of its 95 % confidence interval, for other spectra of these classes (Obuchowski "
        "1997)"
    ),
    "detection_auc_high": "upper end of its 95 % confidence interval",
    "detection_auc_predicted": (
        "what detection_auc is expected to be from the classes and the predicted noise alone: the "
        "mean over the lenslets of other classes of Phi(difference of the filter's means / root "
        "of the sum of its variances)"
    ),
    "target_contrast": (
        "mean answer of that filter on the class of --detect less that on the others, over the "
        "standard deviation on the others"
    ),
    "class_distance": "distance of the two classes that are hardest to tell, standard deviations",
}


@dataclass(frozen=True)
class Classes:
    """What is to be told apart.

    names: of the classes.
    means: (class, band).
    covariance: (band, band) of spectra about the mean of their class.
    examples: (spectrum, band) and (spectrum,) number of their class; without any the means.
    """

    names: tuple[str, ...]
    means: np.ndarray
    covariance: np.ndarray
    examples: tuple[np.ndarray, np.ndarray] | None = None

    @classmethod
    def of_spectra(cls, labels: Sequence[str], spectra: np.ndarray) -> Classes:
        """The classes of labelled spectra.

        labels: (spectrum,) names; those that are equal are one class.
        spectra: (spectrum, band).
        """
        names = tuple(dict.fromkeys(labels))
        member = np.array([names.index(label) for label in labels])
        means = np.stack([spectra[member == k].mean(axis=0) for k in range(len(names))])
        apart = spectra - means[member]
        free = len(spectra) - len(names)
        covariance = apart.T @ apart / free if free else np.zeros((apart.shape[1],) * 2)
        return cls(names, means, covariance, (spectra, member))

    def nearest(self, spectra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The example that each of `spectra` (spectrum, band) is nearest to in the metric of the
        covariance, and its class: numbers, (spectrum,) each.
        """
        from scipy.spatial import KDTree

        known, member = self.examples or (self.means, np.arange(len(self.means)))
        root = whitening(self.covariance)
        place = KDTree(known @ root).query(spectra @ root)[1]
        return place, member[place]


@dataclass(frozen=True, kw_only=True)
class DetectionScore:
    """How well one class stands out from the others, see DEFINITIONS."""

    detection_auc: float
    detection_auc_low: float
    detection_auc_high: float
    detection_auc_predicted: float
    target_contrast: float


@dataclass(frozen=True, kw_only=True)
class ClassScore:
    """How well classes are told apart, see DEFINITIONS; None where the noise is not known, and
    detection where no class is looked for or the truth shows it alone or not at all.
    """

    classes_seen: int
    class_accuracy: float
    class_accuracy_low: float
    class_accuracy_high: float
    class_accuracy_predicted: float | None
    class_distance: float | None
    detection: DetectionScore | None = None


def score_classes(
    values: np.ndarray,
    truth: np.ndarray,
    sigma: np.ndarray | None,
    classes: Classes,
    detect: str | None = None,
    learnt: bool = False,
) -> ClassScore | None:
    """Spectra told apart.

    values, truth: (band, row, column).
    sigma: predicted standard deviation, like values; None: not known.
    classes: of spectra in the same bands.
    detect: name of the class that is looked for, one of theirs.
    learnt: whether lenslets are judged by what other lenslets of each class look like, and not by
        what the classes are.

    Returns None where no lenslet has values, truth and, if any has, noise.
    """
    bands = len(values)
    cubes = [values, truth] if sigma is None else [values, truth, sigma]
    known = np.isfinite(np.stack(cubes)).all(axis=(0, 1))
    if not known.any():
        return None
    found, true = values[:, known].T, truth[:, known].T
    noise = np.zeros((bands, bands))
    if sigma is not None:
        noise = np.diag(np.mean(sigma[:, known] ** 2, axis=1))
    spread = classes.covariance + noise
    shown, right = classes.nearest(true)
    said = (
        learnt_classes(found, right, folds_of(shown, right))
        if learnt
        else assigned(found, classes.means, spread)
    )
    hits = said == right
    low, high = share_interval(hits, shown, right)
    seen, counts = np.unique(right, return_counts=True)
    distances = distances_between(classes.means, spread) if sigma is not None else None
    return ClassScore(
        classes_seen=len(seen),
        class_accuracy=float(hits.mean()),
        class_accuracy_low=low,
        class_accuracy_high=high,
        class_accuracy_predicted=None
        if distances is None
        else float(np.average(predicted_accuracy(distances)[seen], weights=counts)),
        class_distance=None if distances is None else float(np.min(distances)),
        detection=None
        if detect is None
        else score_detection(
            found, shown, right, Filter.of(classes, detect, spread), classes, spread
        ),
    )


@dataclass(frozen=True, kw_only=True)
class Filter:
    """The linear filter that one class stands out by.

    target: number of the class.
    weights: (band,).
    """

    target: int
    weights: np.ndarray

    @classmethod
    def of(cls, classes: Classes, name: str, spread: np.ndarray) -> Filter:
        """The filter for the class `name`.

        spread: (band, band) covariance of spectra of one class, with noise.

        Fisher's discriminant between it and the mixture of the others in equal parts.
        """
        place = classes.names.index(name)
        others = np.delete(classes.means, place, axis=0)
        mixed = spread + np.cov(others.T, ddof=0) if len(others) > 1 else spread
        root = whitening((spread + mixed) / 2)
        apart = classes.means[place] - others.mean(axis=0)
        return cls(target=place, weights=root @ (root.T @ apart))

    def auc(self, means: np.ndarray, spread: np.ndarray, counts: np.ndarray) -> float:
        """Expected area under the receiver operating characteristic of classes that answer as
        normal distributions do.

        means: (class, band) of what is answered to.
        spread: (band, band), its covariance within a class.
        counts: (class,) how many there are of each, at least one of another class than the target.
        """
        from scipy.special import ndtr

        margin = (means[self.target] - means) @ self.weights
        deviation = np.sqrt(2 * self.weights @ spread @ self.weights)
        others = np.where(np.arange(len(means)) == self.target, 0, counts)
        told = ndtr(margin / deviation) if deviation > 0 else (1 + np.sign(margin)) / 2
        return float(np.average(told, weights=others))


def score_detection(
    spectra: np.ndarray,
    shown: np.ndarray,
    labels: np.ndarray,
    known: Filter,
    classes: Classes,
    spread: np.ndarray,
) -> DetectionScore | None:
    """How well a filter's answers tell its class.

    spectra: (spectrum, band).
    shown: (spectrum,) number of what is seen; equal ones show the same.
    labels: (spectrum,) numbers of their classes.
    classes, spread: what is known of them, and the covariance (band, band) of one class with noise.

    Returns None where all or none are of the class.
    """
    from scipy.stats import rankdata

    target = labels == known.target
    count = int(target.sum())
    rest = len(target) - count
    if not count or not rest:
        return None
    answers = spectra @ known.weights
    ranks, own = rankdata(answers), np.empty(len(answers))
    own[target], own[~target] = rankdata(answers[target]), rankdata(answers[~target])
    # of each, the share of the other side that it is on the right side of
    above = (ranks - own) / np.where(target, rest, count)
    right = np.where(target, above, 1 - above)
    auc = float(right[target].mean())
    parts = [mean_variance(right[side], shown[side], labels[side]) for side in (target, ~target)]
    reach = sum(t * t * variance for variance, t in parts) ** 0.5
    deviation = float(answers[~target].std())
    apart = float(answers[target].mean() - answers[~target].mean())
    counts = np.bincount(labels, minlength=len(classes.means))
    return DetectionScore(
        detection_auc=auc,
        detection_auc_low=max(auc - reach, 0.0),
        detection_auc_high=min(auc + reach, 1.0),
        detection_auc_predicted=known.auc(classes.means, spread, counts),
        target_contrast=apart / deviation if deviation > 0 else np.inf,
    )


def mean_variance(values: np.ndarray, shown: np.ndarray, labels: np.ndarray) -> tuple[float, float]:
    """Variance of the mean of values as it is for other spectra of the same classes, and how many
    of its roots reach to the ends of a 95 % confidence interval (Student's t).

    values: (lenslet,).
    shown: (lenslet,) number of the spectrum that each shows.
    labels: (lenslet,) class of that spectrum. Of a class with one spectrum the lenslets count as
        independent.
    """
    from scipy.stats import t

    parts = []
    for label in np.unique(labels):
        ours = labels == label
        _, place = np.unique(shown[ours], return_inverse=True)
        place = place if place.any() else np.arange(len(place))
        sums = np.bincount(place, values[ours] - values[ours].mean())
        free = max(len(sums) - 1, 1)
        parts.append((float(sums @ sums) * len(sums) / free, free))
    variance = sum(part for part, _ in parts)
    # Satterthwaite's degrees of freedom of a sum
    square = sum(part * part / free for part, free in parts)
    reach = float(t.ppf(0.975, variance * variance / square)) if square else 1.959964
    return variance / len(values) ** 2, reach


def share_interval(hits: np.ndarray, shown: np.ndarray, labels: np.ndarray) -> tuple[float, float]:
    """95 % confidence interval of a share (Wilson 1927), in which there are as many lenslets as
    independent ones would vary like it does over the spectra of each class (Korn and Graubard
    1998), at most all and at least one for every spectrum.

    hits: (lenslet,) bool.
    shown, labels: as for mean_variance.
    """
    count, share = len(hits), float(hits.mean())
    fewest = len(np.unique(shown))
    if fewest == len(np.unique(labels)):
        return wilson(share, count)
    variance, reach = mean_variance(hits.astype(float), shown, labels)
    even = share * (1 - share) * (1.959964 / reach) ** 2
    # where all or none are told rightly nothing says how much spectra differ
    independent = even / variance if variance > 0 else fewest
    return wilson(share, min(max(independent, fewest), count))


def assigned(spectra: np.ndarray, means: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(spectrum,) number of the likeliest class.

    spectra: (spectrum, band).
    means: (class, band).
    covariance: (band, band) that all classes share; where it is singular, plain distances count.
    """
    root = whitening(covariance)
    distance = np.linalg.norm((spectra[:, None] - means[None]) @ root, axis=-1)
    return distance.argmin(axis=1)


def folds_of(shown: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(lenslet,) which of FOLDS parts each is judged in: spectra of one class go to different
    parts whole, so that none is judged by what it taught; a class of one spectrum is shared out by
    its lenslets.

    shown, labels: (lenslet,) number of the spectrum that each shows, and of its class.
    """
    folds = np.empty(len(labels), int)
    for label in np.unique(labels):
        ours = labels == label
        _, place = np.unique(shown[ours], return_inverse=True)
        folds[ours] = (place if place.any() else np.arange(len(place))) % FOLDS
    return folds


def learnt_classes(spectra: np.ndarray, labels: np.ndarray, folds: np.ndarray) -> np.ndarray:
    """(spectrum,) likeliest class of each, as the others know the classes: those of one part are
    judged by the rest.

    spectra: (spectrum, band).
    labels: (spectrum,) numbers.
    folds: (spectrum,) number of its part.
    """
    said = np.empty(len(labels), int)
    for part in np.unique(folds):
        judged = folds == part
        if judged.all():
            return labels
        rest = Classes.of_spectra([str(label) for label in labels[~judged]], spectra[~judged])
        place = assigned(spectra[judged], rest.means, rest.covariance)
        said[judged] = np.array(rest.names, int)[place]
    return said


def distances_between(means: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(class, class) Mahalanobis distances, infinite on the diagonal."""
    root = whitening(covariance)
    found = np.linalg.norm((means[:, None] - means[None]) @ root, axis=-1)
    np.fill_diagonal(found, np.inf)
    return found


def predicted_accuracy(distances: np.ndarray) -> np.ndarray:
    """(class,) least share that is told rightly, from distances (class, class) between classes of
    equal covariance.
    """
    from scipy.special import ndtr

    return np.clip(1 - ndtr(-distances / 2).sum(axis=1), 0.0, 1.0)


def wilson(share: float, count: float) -> tuple[float, float]:
    """95 % confidence interval of a share (Wilson 1927).

    count: of independent trials, not necessarily whole.
    """
    square = 1.959964**2 / count
    middle = (share + square / 2) / (1 + square)
    reach = (square * (share * (1 - share) + square / 4)) ** 0.5 / (1 + square)
    return max(middle - reach, 0.0), min(middle + reach, 1.0)


def whitening(covariance: np.ndarray) -> np.ndarray:
    """(band, band) W with W W^T the inverse of a covariance; the identity where there is none."""
    values, vectors = np.linalg.eigh(covariance)
    if not values[0] > 1e-12 * max(values[-1], 1e-300):
        return np.eye(len(covariance))
    return vectors / np.sqrt(values)
