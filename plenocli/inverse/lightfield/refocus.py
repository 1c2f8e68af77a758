"""What a lenslet array tells of depth: views through parts of the main lens, pictures focused
elsewhere, and a map of depths.

A pixel q beyond the centre c of its superpixel (both px on the sensor) sees through the point U =
-q z2/b of the main lens, z2 in front of the lenslets that stand b in front of the sensor. A point
imaged z' behind the main lens meets there the sensor's picture at

    x = c + s q,    s = (1 + z2/b) (1 - z2/z'),    1/z' = 1/f - 1/z,

whatever pixel saw it: s = 0 is the plane focused on the lenslets, s = 1 the sensor itself, and
points nearer to the camera have s > 0. Refocusing puts every sample at its x. Source:
docs/model.md, "Refocusing and depth"; R. Ng et al., Stanford CTSR 2005-02.
"""

from dataclasses import dataclass

import numpy as np

STEP = 4
"""Points of a refocused picture per lenslet pitch."""
ROUNDS = 4
"""Corrections of a depth map by least squares."""


@dataclass(frozen=True)
class Samples:
    """What the usable pixels saw: centre (sample, 2) px, offset (sample, 2) px from it, value
    (sample,) relative to white;

    pitch: px.
    """

    centre: np.ndarray
    offset: np.ndarray
    value: np.ndarray
    pitch: float

    def reach(self):
        """Farthest usable pixel from its centre, px: half of the pupil's image."""
        return float(np.sqrt((self.offset**2).sum(axis=1).max()))


def collect(signal, white, centres, valid, pitch, threshold=0.5):
    """Samples of a mosaic.

    signal, white (row, column): dark taken off;
    centres (lenslet_row, lenslet_column, 2) px, row and column;
    valid (lenslet_row, lenslet_column). A pixel counts where white is above `threshold` of the
        brightest of its superpixel, and within half a pitch.
    """
    half = int(pitch // 2)
    steps = np.arange(-half, half + 1)
    near = np.rint(np.where(np.isfinite(centres), centres, -1e6)).astype(int)
    rows, columns = (
        near[..., axis, None, None] + grid
        for axis, grid in enumerate(np.meshgrid(steps, steps, indexing="ij"))
    )
    inside = (
        (rows >= 0)
        & (rows < signal.shape[0])
        & (columns >= 0)
        & (columns < signal.shape[1])
        & valid[..., None, None]
    )
    rows, columns = np.where(inside, rows, 0), np.where(inside, columns, 0)
    level = np.where(inside, white[rows, columns], 0.0)
    offset = np.stack([rows, columns], axis=-1) - centres[:, :, None, None, :]
    used = (
        inside
        & (level > threshold * level.max(axis=(2, 3), keepdims=True))
        & (np.abs(offset).max(axis=-1) <= pitch / 2)
        & np.isfinite(signal[rows, columns])
    )
    return Samples(
        np.broadcast_to(centres[:, :, None, None, :], offset.shape)[used],
        offset[used],
        signal[rows, columns][used] / level[used],
        float(pitch),
    )


def views(samples, count, shape):
    """Pictures through count x count parts of the pupil: (view_row, view_column, row, column),
    one value a lenslet pitch; shape (row, column).
    """
    reach = samples.reach() * np.sqrt(0.5)
    edges = np.linspace(-reach, reach, count + 1)
    place = np.digitize(samples.offset, edges) - 1
    found = np.zeros((count, count, *shape))
    for row in range(count):
        for column in range(count):
            some = (place[:, 0] == row) & (place[:, 1] == column)
            part = Samples(
                samples.centre[some], samples.offset[some], samples.value[some], samples.pitch
            )
            found[row, column] = refocus(part, 0.0, shape, step=1)[0] if some.any() else np.nan
    return found


def refocus(samples, slope, shape, step=STEP):
    """(picture, spread): the mean and the variance of what meets each point of the plane of this
    slope, (step row, step column).

    slope: a number, or one a sample for a scene of several depths.

    Points stand `step` to a pitch from the sensor's corner; what is within a pitch counts with a
    weight that falls linearly, so that one lenslet's width is the resolution. NaN
    where nothing is near.
    """
    from scipy.ndimage import convolve1d

    place = _place(samples, slope, step)
    rows, columns = shape[0] * step, shape[1] * step
    low = np.floor(place).astype(int)
    part = place - low
    sums = np.zeros((3, rows * columns))
    for down in (0, 1):
        for right in (0, 1):
            r, c = low[:, 0] + down, low[:, 1] + right
            share = np.abs(1 - down - part[:, 0]) * np.abs(1 - right - part[:, 1])
            inside = (r >= 0) & (r < rows) & (c >= 0) & (c < columns)
            index, share, value = (r * columns + c)[inside], share[inside], samples.value[inside]
            for total, weights in zip(sums, (share, share * value, share * value**2)):
                total += np.bincount(index, weights, rows * columns)
    tent = 1 - np.abs(np.arange(1 - step, step)) / step
    weight, first, second = (
        convolve1d(
            convolve1d(s.reshape(rows, columns), tent, axis=0, mode="constant"),
            tent,
            axis=1,
            mode="constant",
        )
        for s in sums
    )
    known = weight > 0.02 * weight.max()
    weight = np.where(known, weight, np.nan)
    picture = first / weight
    return picture, np.maximum(second / weight - picture**2, 0)


def _place(samples, slope, step):
    """Where the samples meet the plane, in points of the picture, (sample, 2)."""
    return (samples.centre + np.reshape(slope, (-1, 1)) * samples.offset) * (step / samples.pitch)


def sharpness(picture):
    """Mean square of the gradient: of pictures of one scene, the largest is the sharpest.

    NaN is left out.
    """
    down, right = np.gradient(picture)
    return float(np.nanmean(down**2 + right**2))


def depth(samples, slopes, shape, window=1.5):
    """(slope, confidence), (row, column), one value a pitch: the slope at which the views agree
    best, of rising `slopes` (at least three).

    Disagreement is the variance of what meets a point beyond that of the picture's own slant within
    a lenslet's width, averaged over a Gaussian of `window` pitches; its least value is found on a
    parabola. confidence: 0 where all slopes agree alike (no texture), towards 1
    where one stands out.
    """
    from scipy.ndimage import gaussian_filter

    slopes = np.asarray(slopes, float)
    floor = 1e-9 * float(np.mean(samples.value**2))
    spread = []
    for slope in slopes:
        picture, one = refocus(samples, slope, shape, step=2)
        for part in np.gradient(picture):
            one = one - (2 * part) ** 2 / 6  # a tent of a pitch to each side has a variance of 1/6
        known = np.isfinite(one)
        weight = gaussian_filter(known.astype(float), 2 * window)
        with np.errstate(divide="ignore", invalid="ignore"):
            smooth = gaussian_filter(np.where(known, one, 0), 2 * window) / weight
        smooth = np.where(known, np.maximum(smooth, 0) + floor, np.nan)
        spread.append(smooth.reshape(shape[0], 2, shape[1], 2).mean(axis=(1, 3)))
    spread = np.array(spread)
    blind = ~np.isfinite(spread).all(axis=0)
    spread[:, blind] = 1.0
    best = np.clip(spread.argmin(axis=0), 1, len(slopes) - 2)
    pick = lambda k: np.take_along_axis(spread, (best + k)[None], 0)[0]
    before, here, after = pick(-1), pick(0), pick(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        move = np.where(
            before + after > 2 * here, (before - after) / (2 * (before - 2 * here + after)), 0.0
        )
        confidence = 1 - spread.min(axis=0) / np.median(spread, axis=0)
    found = np.interp(best + np.clip(np.nan_to_num(move), -1, 1), np.arange(len(slopes)), slopes)
    for _ in range(ROUNDS):
        found = np.clip(found + _correction(samples, found, shape, window), slopes[0], slopes[-1])
    return np.where(blind, np.nan, found), np.where(
        blind, 0.0, np.clip(np.nan_to_num(confidence), 0, 1)
    )


def _correction(samples, slope, shape, window):
    """By how much the slope (row, column) should change, from how the samples differ from the
    picture p at their places: at a wrong slope v - p = ds (grad p . q), solved for ds by least
    squares over a Gaussian of `window` pitches; at most half a unit.
    """
    from scipy.ndimage import gaussian_filter, map_coordinates

    own = map_coordinates(slope, samples.centre.T / samples.pitch - 0.5, order=1, mode="nearest")
    picture, _ = refocus(samples, own, shape, step=STEP)
    picture = np.where(np.isfinite(picture), picture, np.nanmean(picture))
    place = _place(samples, own, STEP).T
    value, down, right = (
        map_coordinates(layer, place, order=1, mode="nearest")
        for layer in (picture, *np.gradient(picture))
    )
    along = (down * samples.offset[:, 0] + right * samples.offset[:, 1]) * (STEP / samples.pitch)
    cell = np.clip((samples.centre / samples.pitch).astype(int), 0, np.array(shape) - 1)
    index = cell[:, 0] * shape[1] + cell[:, 1]
    top, bottom = (
        gaussian_filter(
            np.bincount(index, w, shape[0] * shape[1]).reshape(shape), window, mode="constant"
        )
        for w in ((samples.value - value) * along, along**2)
    )
    return np.clip(top / np.maximum(bottom, 1e-30 + 1e-6 * bottom.max()), -0.5, 0.5)


def slope_of(distance, focal_length, image_distance, sensor_distance):
    """s of the plane `distance` in front of the main lens (m; may be inf): see above."""
    inverse = 1 / focal_length - (0.0 if np.isinf(distance) else 1 / distance)
    return (1 + image_distance / sensor_distance) * (1 - image_distance * inverse)


def distance_of(slope, focal_length, image_distance, sensor_distance):
    """Distance (m) in front of the main lens of the plane of slope s, the inverse of `slope_of`;
    inf beyond infinity.
    """
    inverse = (
        1 / focal_length
        - (1 - np.asarray(slope, float) / (1 + image_distance / sensor_distance)) / image_distance
    )
    with np.errstate(divide="ignore"):
        return np.where(inverse > 0, 1 / np.where(inverse > 0, inverse, 1.0), np.inf)
