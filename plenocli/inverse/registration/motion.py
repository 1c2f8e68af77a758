"""Where the lenslets of a capture are, relative to their calibration, from the capture itself.

Between calibration and capture a lenslet array moves by parts of a pixel. A superpixel then shows
F(p - d) b + o instead of F(p) b: d (rows, columns) px is the displacement, b the radiances of the
bands, o an offset that both share. All three are fitted to the pixels of a lenslet; displacements
of many lenslets make a rigid motion with stretch, d = m + M (c - c0). A gain of the whole capture
cannot be told from brighter radiances, and a mixture of bands that every cell shares looks like
other radiances: neither is visible here. docs/model.md, "Registration".
"""

import threading
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

ITERATIONS = 8
REACH = 4  # px: how far the search for a whole-pixel displacement goes
DEGREE = 5
SAMPLE = 48  # lenslets that tell the motion; the answer is far better known than it needs to be
GAIN_PIXELS = 30_000  # that tell the gains of a mosaic's colours
EXACT = 1e-3  # of a band's peak: what a response without a variance is taken to be known to
# of a band's best colour: a colour with less response is filled in from its neighbours
# before interpolation
WEAK = 0.02
# of a band's peak: pixels whose interpolated response may be off by more take no part
UNSURE = 0.02
SIGNIFICANT = 4.0  # standard deviations
CLOSE = 0.01  # px: a step after which the next would be 1e-4 px
GOOD_FIT = 1.5  # residual over noise, mean squares, up to which a fit needs no second look
LEAST_SHIFT = 0.01  # px: what less than this costs is below the noise of one lenslet


@dataclass(frozen=True)
class Motion:
    """Displacement of superpixels at c (rows, columns) px: shift + matrix (c - middle).

    offset: in the values' unit.

    sigma: standard deviations of (row shift, column shift, offset);
    offset NaN where no pixel of a superpixel tells it from light.
    stray: light that the calibration does not know, spread over superpixels, in shares of their
        mean light, and its standard deviation (NaN where all lenslets are alike).
    before, after: mean square of the residual over the expected one, median over the lenslets used,
        without and with the motion.
    lenslets: how many were used;
    reach: of the largest displacement over the array, px.
    """

    shift: np.ndarray
    matrix: np.ndarray
    middle: np.ndarray
    offset: float
    stray: float
    sigma: np.ndarray
    stray_sigma: float
    before: float
    after: float
    lenslets: int
    reach: float

    def at(self, centres):
        """Displacements (..., 2) px at centres (..., 2) px."""
        return self.shift + (np.asarray(centres, float) - self.middle) @ self.matrix.T

    @property
    def rotation(self):
        """Radians, positive where columns to the right move up (counter-clockwise in a picture
        whose rows go down).
        """
        return float(self.matrix[1, 0] - self.matrix[0, 1]) / 2

    @property
    def moved(self):
        """Whether the lenslets moved by more than chance, enough to matter and not further
        than can be followed.
        """
        return bool(
            self.reach < REACH + 2
            and self.reach > max(LEAST_SHIFT, SIGNIFICANT * np.hypot(*self.sigma[:2]))
        )

    @property
    def lifted(self):
        """Whether there is an offset by more than chance."""
        return bool(abs(self.offset) > SIGNIFICANT * self.sigma[2])

    @property
    def strayed(self):
        """Whether there is light that the calibration does not know."""
        return bool(abs(self.stray) > max(0.002, SIGNIFICANT * self.stray_sigma))


def spline_matrix(count, shift, degree=DEGREE, derivative=False):
    """Matrices (..., count, count): samples f(0..count-1) to samples of f(x - shift), or to its
    derivative by shift.

    f is the interpolating spline of `degree` 3 or 5 with mirrored ends. shift (...), in px.
    """
    from scipy.interpolate import BSpline

    shift, places = np.unique(shift, return_inverse=True)  # of a moved array, many are alike
    half = (degree + 1) // 2
    kernel = BSpline.basis_element(np.arange(degree + 2) - (degree + 1) / 2, extrapolate=False)

    def weights(position, order):
        """Coefficients of the B-spline (position..., count) that its value, or derivative for
        order 1, at `position` (px) takes.
        """
        first = np.floor(position).astype(int) - half + 1
        taps = first[..., None] + np.arange(2 * half)
        value = np.nan_to_num(
            (kernel.derivative() if order else kernel)(position[..., None] - taps)
        )
        folded = np.abs(taps) % (2 * (count - 1))
        folded = np.where(folded > count - 1, 2 * (count - 1) - folded, folded)
        out = np.zeros((*position.shape, count))
        for k in range(2 * half):
            at = folded[..., k : k + 1]
            np.put_along_axis(out, at, np.take_along_axis(out, at, -1) + value[..., k : k + 1], -1)
        return out

    index = np.arange(count, dtype=float)
    fit = np.linalg.inv(weights(index, 0))
    position = index - shift[:, None].astype(float)
    return ((-1 if derivative else 1) * (weights(position, int(derivative)) @ fit))[places]


class Smooth:
    """Responses without the colours of the mosaic: F = gain(colour of the pixel, band) * smooth,
    and smooth can be moved.

    response (lenslet, pixel, band) with NaN at pixels that are not known;
    origin (lenslet, 2) first pixels;
    window (h, w);
    cfa "mono" or four letters. Under narrow-band light the mosaic's filters multiply the picture of
        the pupil by one number each, which is why a motion by an odd number of pixels can
        be followed at all.
    gains (letter, band): None measures them.
    smooth (lenslet, band, h, w).
    """

    def __init__(self, response, origin, window, cfa, gains=None):
        self._set(window, cfa, gains)
        response = np.ascontiguousarray(np.swapaxes(response, -1, -2), np.float32).reshape(
            len(response), -1, *self.window
        )
        known = np.isfinite(response).all(axis=1)
        if gains is None:
            self._set(
                window,
                cfa,
                self._measure(response, known, origin)
                if len(self.letters) > 1
                else np.ones((1, response.shape[1]), np.float32),
            )
        self.smooth = self._without_colours(response, known, origin)

    @classmethod
    def of(cls, pictures, window, cfa, gains):
        """From smooth pictures (lenslet, band, h, w) made before."""
        out = cls.__new__(cls)
        out._set(window, cfa, gains)
        out.smooth = pictures
        return out

    def _set(self, window, cfa, gains):
        self.window, self.cfa, self.gains = tuple(window), cfa, gains
        self.letters = tuple(dict.fromkeys(cfa)) if cfa != "mono" else ("Y",)
        self._tiles = (
            None
            if gains is None or len(self.letters) == 1
            else np.moveaxis(np.asarray(gains, np.float32)[self._colours(PARITIES)], -1, 1).copy()
        )

    def _without_colours(self, response, known, origin):
        """Pictures (lenslet, band, h, w) over their gains; unknown pixels and weak colours
        filled in from their neighbours.
        """
        if self._tiles is None:
            return (
                response
                if known.all()
                else _filled(response, np.broadcast_to(known[:, None], response.shape))
            )
        strong = self._tiles > WEAK
        over = np.where(strong, 1 / np.maximum(self._tiles, WEAK), 0)
        kind = _parity(origin)
        smooth = over[kind]
        smooth *= response
        if strong.all() and known.all():
            return smooth
        good = strong[kind]
        good &= known[:, None]
        some = ~good.all(axis=(0, 2, 3))  # bands that need it
        smooth[:, some] = _filled(smooth[:, some], good[:, some])
        return smooth

    def _measure(self, response, known, origin):
        where = self._colours(origin)
        sites = [known & (where == k) for k in range(len(self.letters))]
        mean = np.stack(
            [np.moveaxis(response, 1, -1)[one].mean(axis=0, dtype=float) for one in sites]
        )
        gains = mean / np.maximum(mean.max(axis=0), 1e-30)
        with np.errstate(divide="ignore", invalid="ignore"):
            smooth = np.where(
                known[:, None], response / np.moveaxis(gains.astype(np.float32)[where], -1, 1), 0
            )
        return (
            gains
            * _flat_ratios(
                _filled(np.nan_to_num(smooth), np.broadcast_to(known[:, None], smooth.shape)), sites
            )
        ).astype(np.float32)

    def _colours(self, origin):
        """Index (lenslet, h, w) into letters."""
        tile = (
            np.array([self.letters.index(c) for c in self.cfa]).reshape(2, 2)
            if len(self.letters) > 1
            else np.zeros((2, 2), int)
        )
        rows = (origin[:, 0, None] + np.arange(self.window[0])) % 2
        columns = (origin[:, 1, None] + np.arange(self.window[1])) % 2
        return tile[rows[:, :, None], columns[:, None, :]]

    def gain(self, origin):
        """Gains (lenslet, band, h, w) of the colours under windows at `origin` (lenslet, 2); the
        number 1 without a mosaic.
        """
        return np.float32(1) if self._tiles is None else self._tiles[_parity(origin)]

    def noise(self, variance, before, after, shift):
        """Variance (pixel, band) of a response that `at` moved from windows at `before` to `after`
        (2,) by shift (2,) px;

        variance (pixel, band): its own. A pixel that takes its value from a weak colour takes its
            noise, which was magnified, too.
        """
        h, w = self.window
        planes = np.nan_to_num(variance).T.reshape(-1, h, w).astype(np.float32)
        gains = [
            np.broadcast_to(self.gain(np.asarray(one)[None]), (1, *planes.shape))[0]
            for one in (before, after)
        ]
        strong = gains[0] > WEAK
        planes = _filled(np.where(strong, planes / np.maximum(gains[0], WEAK) ** 2, 0), strong)
        rows, columns = (spline_matrix(n, shift[k]) ** 2 for k, n in enumerate((h, w)))
        return ((rows @ planes @ columns.T) * gains[1] ** 2).reshape(len(planes), -1).T

    def _sure(self, shift):
        """Mask (lenslet, h, w) of pixels whose spline is good: a sixth difference shows what a
        spline cannot know.

        It passes the frequencies near Nyquist's, which alias; a shift by half a pixel errs by about
        all of them. Where a band would lose more than half of its light (cells of a few pixels),
        nothing is masked.
        """
        aliased = np.abs(np.sin(np.pi * shift)).astype(np.float32)
        if aliased.sum(axis=1).max() < UNSURE:  # no difference is larger than the peak
            return np.ones((len(self.smooth), *self.window), bool)
        light = np.maximum(self.smooth, 0)
        peak = np.maximum(light.max(axis=(2, 3), keepdims=True), 1e-30)
        error = sum(
            aliased[:, axis - 2, None, None, None] * _sixth_difference(self.smooth, axis)
            for axis in (2, 3)
        )
        good = (error < UNSURE * peak).all(axis=1)
        flat = light.reshape(*light.shape[:2], -1)
        kept = (flat @ good.reshape(len(good), -1, 1).astype(np.float32))[..., 0] / np.maximum(
            flat.sum(axis=-1), 1e-30
        )
        return good | (kept < 0.5).any(axis=-1)[:, None, None]

    def at(self, origin, shift, derivatives=False, sharp=True):
        """Responses (lenslet, pixel, band) of windows at `origin` (lenslet, 2) whose light is
        displaced by `shift` (lenslet or 1, 2) px within them; with derivatives also those by row
        and by column shift. Rows and columns that the shift brings in from outside are NaN, and so
        are pixels that the spline cannot be trusted at unless sharp is False.
        """
        h, w = self.window
        rows, columns = (_matrices(n, shift[:, k]) for k, n in enumerate((h, w)))
        gain = self.gain(origin)
        across = self.smooth @ np.swapaxes(columns, -1, -2)
        out = [rows @ across]
        if derivatives:
            by_row, by_column = (
                _matrices(n, shift[:, k], derivative=True) for k, n in enumerate((h, w))
            )
            out += [by_row @ across, rows @ (self.smooth @ np.swapaxes(by_column, -1, -2))]
        for part in out:
            part *= gain
        seen = (
            _seen(np.arange(h), shift[:, 0], h)[:, :, None]
            & _seen(np.arange(w), shift[:, 1], w)[:, None, :]
        )
        if sharp:
            seen = seen & self._sure(shift)
        if not seen.all():
            np.copyto(out[0], np.float32(np.nan), where=~seen[:, None])
        flat = [np.swapaxes(part.reshape(*part.shape[:2], h * w), -1, -2) for part in out]
        return flat if derivatives else flat[0]


def _matrices(count, shift, **kind):
    """spline_matrix for every band of a lenslet, (lenslet, 1, count, count) float32."""
    return spline_matrix(count, shift, **kind).astype(np.float32)[:, None]


PARITIES = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])


def _parity(origin):
    """Index (lenslet,) into PARITIES of windows by their first pixels."""
    return origin[:, 0] % 2 * 2 + origin[:, 1] % 2


def _flat_ratios(pictures, sites):
    """Median (site class, band) of pictures (lenslet, band, h, w) over their local means,
    where there is light.

    The local mean weighs the four positions of a 2x2 mosaic alike and slopes cancel in it. Three
    pixels from any edge are left out: there colours sample the picture at different places.
    """
    from scipy.ndimage import convolve1d, minimum_filter

    local = pictures
    for axis in (2, 3):
        local = convolve1d(local, np.array([1, 2, 1], np.float32) / 4, axis, mode="nearest")
    bright = local > 0.5 * np.percentile(local, 99.5, axis=(2, 3), keepdims=True)
    bright = minimum_filter(bright, (0, 0, 7, 7), mode="constant")
    out = np.ones((len(sites), pictures.shape[1]))
    for k, site in enumerate(sites):
        for band in range(pictures.shape[1]):
            where = site & bright[:, band]
            if where.sum() >= 12:
                out[k, band] = np.median(pictures[:, band][where] / local[:, band][where])
    return out


def _seen(index, shift, count):
    """Which samples (lenslet, count) come from inside, a pixel's margin kept where there
    is a shift at all.
    """
    position = index - shift[:, None]
    margin = np.where(np.abs(shift) > LEAST_SHIFT / 2, 0.5, -1e-6)[:, None]
    return (position >= margin) & (position <= count - 1 - margin)


def _sixth_difference(pictures, axis):
    """Largest |[1, -6, 15, -20, 15, -6, 1] / 64| of each sample and its two neighbours along an
    axis; edges go on as they end.
    """
    pad = [(0, 0)] * pictures.ndim
    pad[axis] = (3, 3)
    rough = np.abs(np.diff(np.pad(pictures, pad, mode="edge"), 6, axis))
    rough *= np.float32(1 / 64)
    low, high, out = (
        (slice(None),) * axis + (slice(None, -1),),
        (slice(None),) * axis + (slice(1, None),),
        rough.copy(),
    )
    np.maximum(out[low], rough[high], out=out[low])
    np.maximum(out[high], rough[low], out=out[high])
    return out


def _filled(values, good):
    """Values (..., h, w), those that are not good replaced by means of their good neighbours,
    farther ones where it takes that.
    """
    out = np.where(good, values, 0)
    kept, weight, todo = out.copy(), good.astype(np.float32), ~good
    for size in (3, 5, 9):
        if not todo.any():
            break
        total, share = _box(kept, size), _box(weight, size)
        ready = todo & (share > 0.5)
        np.divide(total, share, out=out, where=ready)
        todo &= ~ready
    return out


def _box(values, size):
    """Sums over size x size neighbours (..., h, w), nothing beyond the edges."""
    for axis in (-2, -1):
        out = values.copy()
        last = values.shape[axis]
        for step in range(1, min(size // 2, last - 1) + 1):
            low, high = (
                (..., slice(a, b)) + (slice(None),) * (-1 - axis)
                for a, b in ((None, last - step), (step, None))
            )
            out[low] += values[high]
            out[high] += values[low]
        values = out
    return values


def own_pixels(window):
    """Mask (pixel,) without the outermost pixels of a window, where the neighbours' light, which
    follows another radiance, would pass for an offset or stray light: none below 16 px, one
    below 32, two above.
    """
    keep = np.ones(tuple(window), bool)
    for axis, count in enumerate(window):
        edge = min(2, count // 16)
        keep &= np.expand_dims(
            (np.arange(count) >= edge) & (np.arange(count) < count - edge), 1 - axis
        )
    return keep.ravel()


class Reference:
    """What registration needs of a calibration, whatever the capture: where lenslets are, and
    smooth responses of a few of them, made when first asked for.

    response (R, C, pixel, band), or (pixel, band) for all;
    origin (R, C, 2) first pixels of the windows (h, w), those of lenslets without
        response far outside;
    centres (R, C, 2) px;
    shape (rows, columns) of the sensor;
    variance (pixel, band) of the response, None: known to EXACT.
    sample: lenslets that tell a motion.
    """

    def __init__(self, response, origin, window, centres, cfa, shape, variance=None, sample=SAMPLE):
        from plenocli.forward.sensor.superpixel import inside

        self.window, self.cfa, self.sample = tuple(window), cfa, sample
        whole = inside(origin - REACH, np.asarray(window) + 2 * REACH, shape)
        place = np.argwhere(whole)
        place = place[_spread(len(place), 4 * sample)]
        if response.ndim > 2 and len(place):
            place = place[np.isfinite(response[tuple(place.T)]).all(axis=-1).mean(axis=-1) > 0.5]
        place = tuple(place.T)
        self.origin, self.centres = origin[place], centres[place]
        self.shared = response.ndim == 2
        self.bases, self.variance = None, variance
        self._response = np.asarray(response[None] if self.shared else response[place], np.float32)
        if not self.shared and len(self.origin):
            self._response = self._clean(self._response)
        corners = centres[np.isfinite(centres).all(axis=-1)].reshape(-1, 2)
        self.middle, self.extremes = (
            corners.mean(axis=0),
            np.array(
                [
                    [f(corners[:, 0]), g(corners[:, 1])]
                    for f in (np.min, np.max)
                    for g in (np.min, np.max)
                ]
            ),
        )
        self._smooth, self._still = {}, {}
        self._lock = threading.Lock()

    def _clean(self, response):
        """Responses without most of their noise, which would draw a motion towards none; `bases` of
        what they have in common by the colours under their windows, and what is
        left of the variance.
        """
        from plenocli.inverse.spectra.low_rank import common

        kinds, known = self.kinds(self.origin), np.isfinite(response)
        variance = (
            self.variance
            if self.variance is not None
            else np.broadcast_to(
                (EXACT * np.nanmax(response, axis=(0, 1))) ** 2, response.shape[1:]
            )
        )
        self.bases = {
            int(kind): common(response[kinds == kind], variance) for kind in np.unique(kinds)
        }
        out = np.empty_like(response)
        for kind, basis in self.bases.items():
            out[kinds == kind] = basis.mixed(basis.coefficients(response[kinds == kind]))
        if self.variance is not None:
            self.variance = self.variance * max(basis.left for basis in self.bases.values())
        return np.where(known, out, np.float32(np.nan))

    def kinds(self, origin):
        """Which colours (lenslet,) windows at `origin` (lenslet, 2) begin on, an index into
        PARITIES; 0 without a mosaic.
        """
        return _parity(origin) if self.cfa != "mono" else np.zeros(len(origin), int)

    @cached_property
    def gains(self):
        """Of the mosaic's colours, from lenslets all over the array, fewer where
        they have many pixels.
        """
        count = self._response.shape[1]
        some = (
            slice(1)
            if self.shared
            else _spread(len(self.origin), int(np.clip(GAIN_PIXELS // count, 12, self.sample)))
        )
        return Smooth(self._response[some], self.origin[some], self.window, self.cfa).gains

    def response(self, which):
        """F (lenslet, pixel, band) of lenslets by their index."""
        return (
            np.broadcast_to(self._response[0], (len(which), *self._response.shape[1:]))
            if self.shared
            else self._response[which]
        )

    def smooth(self, which):
        """Smooth responses of lenslets by their index."""
        self._make(which)
        return Smooth.of(
            np.stack([self._smooth[key] for key in self._keys(which)]),
            self.window,
            self.cfa,
            self.gains,
        )

    def still(self, which):
        """F and its derivatives by row and by column shift (lenslet, 3 * band, pixel)
        where nothing moved.
        """
        self._make(which)
        return np.stack([self._still[key] for key in self._keys(which)])

    def _keys(self, which):
        """What lenslets have in common if they share a response: the colours
        under their windows.
        """
        return (
            [tuple(o % 2) for o in self.origin[which]] if self.shared else [int(n) for n in which]
        )

    def _make(self, which):
        with self._lock:
            missing = {
                key: number
                for number, key in zip(which, self._keys(which))
                if key not in self._smooth
            }
            if not missing:
                return
            todo = np.array(list(missing.values()))
            smooth = Smooth(
                self.response(todo), self.origin[todo], self.window, self.cfa, self.gains
            )
            parts = _stacked(
                smooth.at(self.origin[todo], np.zeros((1, 2)), derivatives=True, sharp=False)
            )
            for k, key in enumerate(self._keys(todo)):
                self._smooth[key], self._still[key] = smooth.smooth[k], parts[k]


def _spread(count, wanted):
    """Indices of at most `wanted` of `count` things, evenly."""
    return (
        np.unique(np.linspace(0, count - 1, min(count, wanted)).astype(int))
        if count
        else np.zeros(0, int)
    )


def motion_since(reference, signal, noise=None):
    """Motion of the lenslets of a capture since their calibration; None where fewer than
    three lenslets show it.

    signal (rows, columns), or a plenocli.forward.sensor.readout.Readout: dark removed,
    NaN where saturated.
    noise: (gain, read variance) of the signal, None: unknown, all pixels weigh the same.
        Displacements beyond REACH px are not found.
    """
    data = _Sample(reference, signal, noise)
    if data.count < 3:
        return None
    first = data.fit(np.zeros(2))
    if first.after <= GOOD_FIT and first.reach <= 0.7:
        return first
    start = data.search()
    if not start.any():
        return first
    return replace(
        min((first, data.fit(start)), key=lambda motion: motion.after), before=first.before
    )


class _Sample:
    """The lenslets that tell the motion: bright, whole and spread over the array."""

    def __init__(self, reference, signal, noise):
        from plenocli.forward.sensor.superpixel import extract

        values = extract(signal, reference.origin[:, None], reference.window)[:, 0]
        known = np.isfinite(values)
        values = np.where(known, values, 0)
        level, power = values.sum(axis=-1, dtype=float), np.vecdot(values, values)
        # of a sum of pixels that are noise alone
        spread = power - level**2 / np.maximum(known.sum(axis=-1), 1)
        level[(known.mean(axis=-1) <= 0.5) | (level < 6 * np.sqrt(np.maximum(spread, 0)))] = 0
        bright = (
            np.flatnonzero(level > 0.25 * np.percentile(level, 90))
            if len(level)
            else np.zeros(0, int)
        )
        self.which = bright[_spread(len(bright), reference.sample)]
        self.reference, self.count, self.signal, self.window, self.noise = (
            reference,
            len(self.which),
            signal,
            reference.window,
            noise,
        )
        self.spread = None if reference.variance is None else np.nan_to_num(reference.variance)
        self.origin, self.centres = reference.origin[self.which], reference.centres[self.which]
        self.middle, self.extremes = reference.middle, reference.extremes

    @cached_property
    def response(self):
        return self.reference.response(self.which)

    @cached_property
    def smooth(self):
        return self.reference.smooth(self.which)

    def values(self, whole):
        from plenocli.forward.sensor.superpixel import extract

        return np.where(
            own_pixels(self.window),
            extract(self.signal, (self.origin + whole)[:, None], self.window)[:, 0].astype(float),
            np.nan,
        )

    def search(self):
        """Displacement (2,) in whole pixels (an even number where there is a colour mosaic) that
        leaves the least residual.
        """
        step = 1 if self.reference.cfa == "mono" else 2
        some = slice(None, None, max(1, self.count // 24))
        known = np.isfinite(self.response[some]).all(axis=-1)
        q = np.linalg.qr(np.where(known[..., None], self.response[some], 0))[0]
        best, where = np.inf, np.zeros(2)
        for row in range(-REACH, REACH + 1, step):
            for column in range(-REACH, REACH + 1, step):
                x = self.values(np.array([row, column]))[some]
                x = np.where(known & np.isfinite(x), x, 0)
                part = 1 - ((np.swapaxes(q, -1, -2) @ x[..., None]) ** 2).sum(
                    axis=(1, 2)
                ) / np.maximum((x**2).sum(axis=1), 1e-30)
                if np.median(part) < best:
                    best, where = np.median(part), np.array([row, column], float)
        return where

    def fit(self, start):
        """Gauss-Newton from displacement `start`: the common motion that leaves the least
        weighted residual.
        """
        affine = (
            self.count >= 12
            and np.linalg.matrix_rank(self.centres - self.middle, tol=1e-3 * np.ptp(self.centres))
            == 2
        )
        arms = (self.centres - self.middle) / np.abs(self.extremes - self.middle).max(axis=0)
        arms = (
            np.concatenate([np.ones((self.count, 1)), arms], axis=1)
            if affine
            else np.ones((self.count, 1))
        )
        q = np.zeros((2, arms.shape[1]))
        q[:, 0] = start
        before = after = None
        for _ in range(ITERATIONS):
            shifts = arms @ q.T
            normal, right, chi, product = self._equations(shifts, arms)
            before = chi if before is None else before
            solved, spread = _solve(normal, right)
            step = solved[: q.size].reshape(q.shape)
            length = np.abs(arms @ step.T).max()
            q = q + step / max(1.0, length)
            if np.abs(q[:, 0]).max() > REACH + 1:
                break
            if length < CLOSE:  # steps shrink by their square
                break
        # a poor fit is bent by what the equations leave out
        linear = length < CLOSE and np.median(chi) < GOOD_FIT
        after = (
            _chi_after(product, chi, arms @ step.T)
            if linear
            else self._equations(arms @ q.T, arms)[2]
        )
        scale = np.sqrt(max(np.median(after), 1.0)) if self.noise is not None else 1.0
        size = np.abs(self.extremes - self.middle).max(axis=0)
        matrix = q[:, 1:] / size if affine else np.zeros((2, 2))
        reach = np.linalg.norm(q[:, 0] + (self.extremes - self.middle) @ matrix.T, axis=1).max()
        sigma = np.array([spread[0], spread[arms.shape[1]], spread[-2]]) * scale
        return Motion(
            q[:, 0].copy(),
            matrix,
            self.middle,
            float(solved[-2]),
            float(solved[-1]),
            sigma,
            float(spread[-1] * scale),
            float(np.median(before)),
            float(np.median(after)),
            self.count,
            float(reach),
        )

    def _equations(self, shifts, arms):
        """Normal equations of (displacement coefficients, offset, stray) with radiances eliminated,
        and chi^2 a lenslet.

        The offset is that of the capture; stray is in shares of each lenslet's mean light. Lenslets
        that fit worse than the median weigh less.
        """
        whole = np.rint(shifts).astype(int)
        if self.reference.cfa == "mono":
            whole = np.broadcast_to(np.rint(shifts.mean(axis=0)).astype(int), whole.shape)
        parts = (
            self._parts(self.origin + whole, shifts - whole)
            if shifts.any()
            else self.reference.still(self.which)
        )
        bands, x = parts.shape[1] // 3, self.values(whole)
        good = np.isfinite(x) & np.isfinite(parts[:, :bands]).all(axis=1)
        x, weight = np.where(good, x, 0), good.astype(float)
        f = np.where(good[:, None], parts[:, :bands], 0)
        if self.noise is not None:
            b = _rough(f, x)
            expected = self.noise[0] * np.clip((b[:, None] @ f)[:, 0], 0, None) + self.noise[1]
            if self.spread is not None:
                expected = expected + b**2 @ self.spread.T
            weight = weight / np.maximum(expected, 1e-12)
        rows = np.concatenate([f, parts[:, bands:], np.ones_like(x)[:, None], x[:, None]], axis=1)
        rows *= np.sqrt(weight)[:, None]
        product = _reduced(
            rows @ np.swapaxes(rows, -1, -2),
            bands,
            f.sum(axis=-1) / np.maximum(good.sum(axis=-1), 1)[:, None],
        )
        chi = product[:, -1, -1] / np.maximum(good.sum(axis=-1) - bands, 1)
        unit = 1.0 if self.noise is not None else max(float(np.median(chi)), 1e-30)
        weight = 1 / unit / np.maximum(1, chi / max(np.median(chi), 1e-30)) ** 2
        terms = arms.shape[1]
        carry = np.zeros((len(arms), 4, 2 * terms + 2))
        carry[:, 0, :terms], carry[:, 1, terms : 2 * terms] = arms, arms
        carry[:, 2, -2] = carry[:, 3, -1] = 1
        turned = np.swapaxes(carry, -1, -2) * weight[:, None, None]
        normal = (turned @ product[:, :4, :4] @ carry).sum(axis=0)
        right = (turned @ product[:, :4, 4:]).sum(axis=0)[:, 0]
        return normal, right, chi, product

    def _parts(self, origin, shifts):
        """F and its derivatives by row and by column shift (lenslet, 3 * band, pixel)."""
        return _stacked(self.smooth.at(origin, shifts, derivatives=True, sharp=False))


def _stacked(parts):
    """Three (lenslet, pixel, band) as one (lenslet, 3 * band, pixel), float64."""
    return np.ascontiguousarray(np.swapaxes(np.concatenate(parts, axis=-1), -1, -2), float)


def _rough(f, x):
    """Radiances (lenslet, band) by normal equations, good enough for weights; f
    (lenslet, band, pixel).
    """
    gram = f @ np.swapaxes(f, -1, -2)
    gram += (1e-10 * np.trace(gram, axis1=-2, axis2=-1) + 1e-300)[:, None, None] * np.eye(
        f.shape[-2]
    )
    return np.linalg.solve(gram, (f @ x[..., None]))[..., 0]


def _reduced(gram, bands, mean):
    """Products (lenslet, 5, 5) of what remains, outside the span of F, of the columns (row shift,
    column shift, offset, stray, x).

    gram: weighted products of F, its derivatives by row and by column shift (band each), 1 and x.
    mean (lenslet, band): of F over pixels. F that cannot tell radiances counts as far as it does.
    """
    size = np.sqrt(np.maximum(np.diagonal(gram, axis1=-2, axis2=-1)[:, :bands], 1e-300))
    inverse = np.linalg.pinv(
        gram[:, :bands, :bands] / (size[:, :, None] * size[:, None]), rcond=1e-12, hermitian=True
    ) / (size[:, :, None] * size[:, None])
    b = (inverse @ gram[:, :bands, -1:])[..., 0]
    light = np.maximum((mean * b).sum(axis=-1), 0)
    rest = gram[:, bands:, bands:] - gram[:, bands:, :bands] @ inverse @ gram[:, :bands, bands:]
    mix = np.zeros((len(gram), rest.shape[-1], 5))
    mix[:, :bands, 0] = mix[:, bands : 2 * bands, 1] = b
    mix[:, -2, 2], mix[:, -2, 3], mix[:, -1, 4] = 1, light, 1
    return np.swapaxes(mix, -1, -2) @ rest @ mix


def _chi_after(product, chi, step):
    """chi a lenslet after a small displacement `step` (lenslet, 2), from the products of the
    equations before it.
    """
    gain = (
        2 * (step * product[:, :2, 4]).sum(axis=-1)
        - (step[:, None] @ product[:, :2, :2] @ step[..., None])[:, 0, 0]
    )
    return chi * (1 - gain / np.maximum(product[:, 4, 4], 1e-300))


def _solve(normal, right):
    """Solution and standard deviations; what the data do not tell is 0 with deviation NaN:
    stray before offset.
    """
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-30))
    spread, solved = np.full(len(right), np.nan), np.zeros(len(right))
    keep = list(range(len(right)))
    for drop in (None, len(right) - 1, len(right) - 2):
        if drop is not None:
            keep.remove(drop)
        unit = normal[np.ix_(keep, keep)] / np.outer(scale[keep], scale[keep])
        if np.linalg.cond(unit) < 1e4:
            break
    inverse = np.linalg.pinv(unit)
    solved[keep] = inverse @ (right[keep] / scale[keep]) / scale[keep]
    spread[keep] = np.sqrt(np.maximum(np.diag(inverse), 0)) / scale[keep]
    return solved, spread
