"""The sums of plenocli.inverse.spectra.factored for one superpixel after another, compiled by
numba; None where it is not installed.

Imported late, because importing numba takes a second. A superpixel's basis is read from memory once
and everything else about it stays in the cache, where the array version passes
over it a dozen times.
"""

import numpy as np

try:
    from plenocli.inverse.compiled import compiled
except ImportError:
    superpixels = None
else:
    _jit = compiled(nogil=True, fastmath={"reassoc", "contract", "nsz"}, forceinline=True)

    @_jit
    def _dot(a, b):
        total = np.float32(0)
        for p in range(a.size):
            total += a[p] * b[p]
        return total

    @_jit
    def _dots(a, rows, first, out):
        """out[k] = a . rows[k] for k from `first`; four at a time, since loading numbers is
        what takes the time.
        """
        k = first
        while k + 3 < len(rows):
            one, two, three, four = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            b, c, d, e = rows[k], rows[k + 1], rows[k + 2], rows[k + 3]
            for p in range(a.size):
                one += a[p] * b[p]
                two += a[p] * c[p]
                three += a[p] * d[p]
                four += a[p] * e[p]
            out[k], out[k + 1], out[k + 2], out[k + 3] = one, two, three, four
            k += 4
        while k < len(rows):
            out[k] = _dot(a, rows[k])
            k += 1

    @_jit
    def _add(weights, rows, out):
        """out += weights @ rows."""
        k = 0
        while k + 3 < len(rows):
            one, two, three, four = (
                np.float32(weights[k]),
                np.float32(weights[k + 1]),
                np.float32(weights[k + 2]),
                np.float32(weights[k + 3]),
            )
            b, c, d, e = rows[k], rows[k + 1], rows[k + 2], rows[k + 3]
            for p in range(out.size):
                out[p] += one * b[p] + two * c[p] + three * d[p] + four * e[p]
            k += 4
        while k < len(rows):
            one, b = np.float32(weights[k]), rows[k]
            for p in range(out.size):
                out[p] += one * b[p]
            k += 1

    @_jit
    def _normal(own, weight, carried, out):
        """Q^T W Q of one superpixel."""
        if len(own) == 4:
            _normal_of_four(own[0], own[1], own[2], own[3], weight, out)
            return
        for i in range(len(own)):
            row = own[i]
            for p in range(weight.size):
                carried[p] = row[p] * weight[p]
            _dots(carried, own, i, out[i])
            for j in range(i):
                out[i, j] = out[j, i]

    @_jit
    def _normal_of_four(a, b, c, d, weight, out):
        """As _normal for the usual four bands: ten sums in one pass, a third of the time."""
        zero = np.float32(0)
        aa, ab, ac, ad, bb, bc, bd, cc, cd, dd = (
            zero,
            zero,
            zero,
            zero,
            zero,
            zero,
            zero,
            zero,
            zero,
            zero,
        )
        for p in range(weight.size):
            w = weight[p]
            wa, wb, wc, wd = w * a[p], w * b[p], w * c[p], w * d[p]
            aa += wa * a[p]
            ab += wa * b[p]
            ac += wa * c[p]
            ad += wa * d[p]
            bb += wb * b[p]
            bc += wb * c[p]
            bd += wb * d[p]
            cc += wc * c[p]
            cd += wc * d[p]
            dd += wd * d[p]
        out[0, 0], out[1, 1], out[2, 2], out[3, 3] = aa, bb, cc, dd
        out[0, 1] = out[1, 0] = ab
        out[0, 2] = out[2, 0] = ac
        out[0, 3] = out[3, 0] = ad
        out[1, 2] = out[2, 1] = bc
        out[1, 3] = out[3, 1] = bd
        out[2, 3] = out[3, 2] = cd

    @_jit
    def superpixels(q, inverse, x, gain, read, known, sandwich, plain, normal, right, spread, chi):
        """Fill plain, right (lenslet, band), normal and, with sandwich, spread (lenslet, band,
        band) and chi (lenslet).

        q (lenslet, band, pixel), x (lenslet, pixel), which becomes the residual, gain, read and
        known (band or 0, pixel): float32;
        inverse (lenslet, band, band): of R, float64. A lenslet with NaN in x gets NaN in
            plain and nothing else.
        """
        count, pixels = x.shape
        variance, weight, carried = (
            np.empty(pixels, np.float32),
            np.empty(pixels, np.float32),
            np.empty(pixels, np.float32),
        )
        square = np.empty(len(known))
        for n in range(count):
            own, r = q[n], inverse[n]
            row, c = x[n], plain[n]
            _dots(row, own, 0, c)
            if np.isnan(c.sum()):
                c[:] = np.nan
                continue
            variance[:] = 0
            _add(c, own, variance)
            for p in range(pixels):
                row[p] -= variance[p]
                variance[p] = variance[p] * gain + read
            if len(known):
                for k in range(len(known)):
                    b = 0.0
                    for j in range(len(own)):
                        b += r[k, j] * c[j]
                    square[k] = max(b, 0.0) ** 2
                _add(square, known, variance)
            for p in range(pixels):
                variance[p] = max(variance[p], read)
                weight[p] = np.float32(1) / variance[p]
            _normal(own, weight, carried, normal[n])
            if sandwich:
                _normal(own, variance, carried, spread[n])
            for p in range(pixels):
                weight[p] *= row[p]
            _dots(weight, own, 0, right[n])
            chi[n] = _dot(weight, row)
