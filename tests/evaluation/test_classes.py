"""Classes of a user's own: what is predicted of them against draws, and tables of spectra."""

import numpy as np
import pytest
from scipy.stats import binomtest

from plenocli.base.errors import InputError
from plenocli.evaluation.metrics import classes
from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.provenance import Provenance
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.read.class_table import read_labelled
from plenocli.forward.scene.labelled import LabelledSpectra, SpectraChart

BANDS = np.array([450e-9, 550e-9, 650e-9])


def library(count, within=0.05, apart=0.08, samples=40, seed=0):
    """Spectra of normally distributed classes: (labels, spectra)."""
    rng = np.random.default_rng(seed)
    means = 0.5 + apart * rng.standard_normal((count, 3))
    root = within * rng.standard_normal((3, 3))
    labels = tuple(f"class {k}" for k in range(count) for _ in range(samples))
    return labels, np.repeat(means, samples, axis=0) + rng.standard_normal(
        (count * samples, 3)
    ) @ root


@pytest.mark.parametrize("count", [2, 5])
def test_what_is_predicted_is_what_draws_show(count):
    """Of two classes to the digit; of several a bound from below that is no more than 0.1 off."""
    known = classes.Classes.of_spectra(*library(count))
    sigma = np.array([0.02, 0.05, 0.03])
    rng = np.random.default_rng(3)
    size = (count, 20000)
    truth = known.means[:, None] + rng.multivariate_normal(np.zeros(3), known.covariance, size)
    said = classes.assigned(
        (truth + sigma * rng.standard_normal(truth.shape)).reshape(-1, 3),
        known.means,
        known.covariance + np.diag(sigma**2),
    )
    hits = np.mean(said.reshape(size) == np.arange(count)[:, None], axis=1)
    distances = classes.distances_between(known.means, known.covariance + np.diag(sigma**2))
    predicted = classes.predicted_accuracy(distances)
    if count == 2:
        np.testing.assert_allclose(hits, predicted, atol=0.01)
    else:
        assert (predicted < hits + 0.01).all() and (predicted > hits - 0.25).all()
        assert predicted.mean() > hits.mean() - 0.15


def test_lenslets_are_told_by_truth_and_noise():
    """Constant classes, noise as predicted: the share is that of the distance, and its interval."""
    means = np.array([[0.2, 0.2, 0.2], [0.3, 0.2, 0.2]])
    known = classes.Classes(("a", "b"), means, np.zeros((3, 3)))
    rng = np.random.default_rng(1)
    label = rng.integers(2, size=(60, 70))
    truth = means[label].transpose(2, 0, 1)
    sigma = np.full(truth.shape, 0.04)
    values = truth + sigma * rng.standard_normal(truth.shape)
    values[:, :5] = np.nan
    score = classes.score_classes(values, truth, sigma, known)
    assert score.classes_seen == 2 and score.class_distance == pytest.approx(2.5)
    assert score.class_accuracy_predicted == pytest.approx(0.8944, abs=1e-4)  # Phi(1.25)
    assert score.class_accuracy_low < 0.8944 < score.class_accuracy_high
    hits = round(score.class_accuracy * 55 * 70)
    interval = binomtest(hits, 55 * 70).proportion_ci(method="wilson")
    assert score.class_accuracy_low == pytest.approx(interval.low)
    assert score.class_accuracy_high == pytest.approx(interval.high)
    # the two shares whose own standard error puts the one seen at 1.96 of it
    for end in (interval.low, interval.high):
        away = abs(hits / (55 * 70) - end) / np.sqrt(end * (1 - end) / (55 * 70))
        assert away == pytest.approx(1.959964, rel=1e-6)
    blind = classes.score_classes(values, truth, None, known)
    assert blind.class_accuracy_predicted is None and blind.class_accuracy > 0.85
    assert classes.score_classes(np.full_like(truth, np.nan), truth, sigma, known) is None


def test_a_table_is_read_in_the_bands_of_a_result(tmp_path):
    (tmp_path / "c.csv").write_text("nm,leaf,soil,leaf\n700,0.5,0.3,0.7\n400,0.1,0.3,0.3\n")
    read = read_labelled(tmp_path / "c.csv", BANDS)
    found = classes.Classes.of_spectra(read.labels, read.at(BANDS))
    assert found.names == ("leaf", "soil")
    np.testing.assert_allclose(found.means, [[4 / 15, 0.4, 8 / 15], [0.3, 0.3, 0.3]])
    np.testing.assert_allclose(found.covariance, 0.02 * np.ones((3, 3)), atol=1e-12)


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "names 0 classes"),
        ("nm,leaf,leaf\n400,1,1\n700,1,1\n", "names 1 classes"),
        ("nm,leaf,\n400,1,1\n700,1,1\n", "names 2 classes"),
        ("nm,leaf,soil\n400,1,high\n700,1,1\n", "no table of numbers"),
        ("nm,leaf,soil\n400,1\n700,1\n", "different length"),
        ("nm,leaf,soil\n400,1,1\n", "fewer than three"),
        ("nm,leaf,soil\n400,1,1\n400,1,1\n", "twice"),
        ("nm,leaf,soil\n400,1,nan\n700,1,1\n", "nan at 400 nm in column 3 .soil., .*not finite"),
        ("nm,leaf,soil\n400,1,1\nnan,1,1\n", "no number"),
        ("nm;leaf;soil\n400;1;2\n700;25.1;1\n", "25.1 at 700 nm in column 2 .*write 0.25"),
        ("nm,leaf,soil\n400,1,-0.2\n700,1,1\n", "-0.2 at 400 nm in column 3 .*below 0"),
        ("nm,leaf,soil\n500,1,1\n700,1,1\n", "there is a band at 450 nm"),
    ],
)
def test_what_is_no_table_of_classes_is_refused(tmp_path, text, words):
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        read_labelled(tmp_path / "c.csv", BANDS)
    with pytest.raises(InputError, match="first column are wavelengths"):
        read_labelled(tmp_path / "missing.csv", BANDS)


def test_learnt_classes_are_those_of_a_discriminant_that_did_not_see_them():
    """scikit-learn's, on the same folds; spectra that are off by a constant cost nothing."""
    lda = pytest.importorskip("sklearn.discriminant_analysis").LinearDiscriminantAnalysis
    labels, spectra = library(3)
    number = np.array([int(name[-1]) for name in labels])
    order = np.random.default_rng(2).permutation(len(number))
    spectra, number = spectra[order] + 0.3, number[order]
    said = classes.learnt_classes(spectra, number, np.arange(len(number)) % 5)
    for part in range(5):
        judged = np.arange(len(number)) % 5 == part
        model = lda(solver="lsqr", priors=[1 / 3] * 3).fit(spectra[~judged], number[~judged])
        np.testing.assert_array_equal(said[judged], model.predict(spectra[judged]))
    right = classes.assigned(spectra - 0.3, *_known(labels, order, spectra - 0.3))
    assert np.mean(said == number) > np.mean(right == number) - 0.05


def _known(labels, order, spectra):
    found = classes.Classes.of_spectra([labels[i] for i in order], spectra)
    place = [int(name[-1]) for name in found.names]
    return found.means[np.argsort(place)], found.covariance


def test_a_folder_is_read_as_its_tables_and_images(tmp_path):
    """Folders, tables and spectral images by the names of their classes, on shared wavelengths."""
    rng = np.random.default_rng(0)
    image = rng.random((3, 4, 5))
    nodes = np.array([450e-9, 550e-9, 660e-9])
    (tmp_path / "leaf").mkdir()
    (tmp_path / "leaf" / "a.csv").write_text("nm,x,y\n400,0.1,0.3\n700,0.5,0.7\n")
    (tmp_path / "leaf" / "b.csv").write_text("nm,z\n440,0.2\n680,0.2\n")
    origin = Provenance(command="")
    data = {"image/value": image, "image/wavelength": nodes}
    write_artefact(tmp_path / "soil.h5", Artefact("image", data, {"image": {}}, origin))
    (tmp_path / "notes.txt").write_text("not a spectrum")
    read = read_labelled(tmp_path, np.array([500e-9, 550e-9]))
    assert read.labels == ("leaf",) * 3 + ("soil",) * 20
    np.testing.assert_allclose(read.wavelengths, nodes)
    np.testing.assert_allclose(read.at(550e-9)[:, 0], [0.3, 0.5, 0.2, *image[1].ravel()])
    np.testing.assert_allclose(read.at(500e-9)[3:, 0], image[:2].mean(axis=0).ravel())
    with pytest.raises(InputError, match="from 450 to 660 nm, there is a band at 440 nm"):
        read_labelled(tmp_path, np.array([440e-9]))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no spectra"):
        read_labelled(tmp_path / "empty")


def test_a_chart_shows_every_spectrum_and_tells_mixed_cells(tmp_path):
    labels = ("a", "a", "b", "b", "c", "c")
    nodes = np.array([400e-9, 700e-9])
    spectra = np.linspace(0, 1, 6)[:, None] * [1.0, 0.5]
    chart = SpectraChart(LabelledSpectra(labels, nodes, spectra))
    seen = chart.at(400e-9, 20, 30)  # 2 x 3 patches of 10 x 10
    np.testing.assert_allclose(seen[::10, ::10].ravel(), spectra[:, 0], rtol=1e-6)
    assert chart.whole(2, 3).all() and not chart.whole(3, 3)[1].any()
    np.testing.assert_allclose(chart.at(550e-9, 2, 3), 0.75 * chart.at(400e-9, 2, 3), rtol=1e-6)
    many = SpectraChart(LabelledSpectra(("a", "b") * 500, nodes, np.ones((1000, 2))))
    assert len(many.spectra.labels) <= 48 and many.spectra.labels.count("a") == 24
    some = SpectraChart(LabelledSpectra(("a", "b", "c", "d") * 13, nodes, np.ones((52, 2))))
    assert [some.spectra.labels.count(name) for name in "abcd"] == [12] * 4


def test_overlapping_classes_are_judged_by_their_names():
    """A truth beyond the mean between two classes is of the class that it was drawn from."""
    known = classes.Classes.of_spectra(*library(2, within=0.1, apart=0.02, samples=30))
    spectra, member = known.examples
    truth = np.repeat(spectra, 4, axis=0).T[:, :, None]
    sigma = np.full(truth.shape, 1e-6)
    plain = classes.score_classes(truth, truth, sigma, known)
    said = classes.assigned(spectra, known.means, known.covariance)
    assert plain.class_accuracy == pytest.approx(np.mean(said == member))
    assert plain.class_accuracy < 0.85
    taught = classes.score_classes(truth, truth, sigma, known, learnt=True)
    assert taught.class_accuracy == pytest.approx(plain.class_accuracy, abs=0.15)


@pytest.mark.parametrize("samples, noise", [(12, 0.01), (12, 0.05), (25, 0.01), (4, 0.05)])
def test_intervals_hold_what_other_spectra_of_the_classes_give(samples, noise):
    """Of shares and areas, by draws of charts of three classes, 40 lenslets a spectrum. Taking
    lenslets as independent, 50 to 70 % of them do.
    """
    rng = np.random.default_rng(7)
    means, root = 0.4 + 0.04 * rng.standard_normal((3, 4)), np.tril(rng.standard_normal((4, 4)))
    covariance = 4e-4 * root @ root.T
    spread = covariance + noise**2 * np.eye(4)
    many = means[:, None] + rng.multivariate_normal(np.zeros(4), spread, (3, 40000))
    told = classes.assigned(many.reshape(-1, 4), means, spread).reshape(3, -1)
    share = np.mean(told == np.arange(3)[:, None])
    inside, inside_area = 0, 0
    member = np.repeat(np.arange(3), samples)
    for _ in range(200):
        drawn = means[member] + rng.multivariate_normal(np.zeros(4), covariance, len(member))
        known = classes.Classes(("a", "b", "c"), means, covariance, (drawn, member))
        truth = np.repeat(drawn, 40, axis=0)
        values = truth + noise * rng.standard_normal(truth.shape)
        cubes = (values.T[..., None], truth.T[..., None], np.full((4, len(truth), 1), noise))
        found = classes.score_classes(*cubes, known, "b")
        inside += found.class_accuracy_low <= share <= found.class_accuracy_high
        area = found.detection
        inside_area += (
            area.detection_auc_low <= area.detection_auc_predicted <= area.detection_auc_high
        )
    assert 0.88 * 200 <= inside and 0.86 * 200 <= inside_area


def test_lenslets_that_show_one_spectrum_are_judged_together():
    shown, labels = np.array([0, 1, 1, 2, 2, 7, 7, 7]), np.array([0, 0, 0, 0, 0, 1, 1, 1])
    assert classes.folds_of(shown, labels).tolist() == [0, 1, 1, 2, 2, 0, 1, 2]


def test_one_class_stands_out_as_the_filter_predicts():
    """Against draws and scikit-learn's area under the curve; the interval by its own coverage."""
    metrics = pytest.importorskip("sklearn.metrics")
    known = classes.Classes.of_spectra(*library(4, apart=0.04))
    sigma = 0.03
    spread = known.covariance + sigma**2 * np.eye(3)
    lens = classes.Filter.of(known, "class 2", spread)

    def found_of(rng, each):
        label = np.repeat(np.arange(4), each)
        values = known.means[label] + rng.multivariate_normal(np.zeros(3), spread, len(label))
        shown = np.arange(len(label))
        return values, label, classes.score_detection(values, shown, label, lens, known, spread)

    values, label, true = found_of(np.random.default_rng(0), 20000)
    # of a mixture whose parts lie apart, no normal distribution tells this
    assert true.detection_auc == pytest.approx(true.detection_auc_predicted, abs=3e-3)
    answers = values @ lens.weights
    rest = answers[label != 2]
    contrast = (answers[label == 2].mean() - rest.mean()) / rest.std()
    assert true.target_contrast == pytest.approx(contrast)
    inside = 0
    for seed in range(100):
        values, label, found = found_of(np.random.default_rng(seed), 60)
        want = metrics.roc_auc_score(label == 2, values @ lens.weights)
        assert found.detection_auc == pytest.approx(want, abs=1e-12)
        inside += found.detection_auc_low <= true.detection_auc <= found.detection_auc_high
    assert 88 <= inside <= 100
    alone = np.full(len(label), 2)
    assert classes.score_detection(values, alone, alone, lens, known, spread) is None
