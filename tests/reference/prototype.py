"""Superpixels of a filtered plenoptic camera in closed form: filter cells with blurred edges, at
any place within the pixels.

A cell is a rectangle in the superpixel, convolved with a Gaussian and integrated over pixels (error
functions), so that a superpixel moved by any part of a pixel is exact and owes nothing
to an interpolation.
"""

import numpy as np
from scipy.special import erf

CELLS = ((0, 0), (0, 1), (1, 0), (1, 1))  # place of the four bands' cells


def edge_integral(x, blur):
    """Primitive of the Gaussian's distribution function: x Phi(x/s) + s phi(x/s)."""
    z = x / blur
    return x * 0.5 * (1 + erf(z / np.sqrt(2))) + blur * np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)


def bar(pixels, low, high, blur):
    """Share of each pixel (..., pixels) that the blurred interval low..high (px from the
    window's middle, (...)) covers.
    """
    edge = np.arange(pixels + 1) - pixels / 2
    low, high = (np.asarray(v, float)[..., None] for v in (low, high))
    light = edge_integral(edge - low, blur) - edge_integral(edge - high, blur)
    return np.diff(light, axis=-1)


def superpixels(
    shift, pixels=52, side=45.4, gap=1.5, blur=0.9, leak=0.05, kind="cells", fall=0.3, pitch=None
):
    """Response (..., pixels^2, 4) of superpixels whose picture is moved by `shift` (..., 2) px; 1
    in a cell without leak.

    leak: share of a band that other filters pass, evenly: within the cells ("cells"), over the
        whole superpixel ("diffuse").
    fall: relative fall of the light across the pupil, along columns of pixels, different by band.
    pitch: width of a superpixel where the window of `pixels` is wider.
    """
    shift = np.asarray(shift, float)
    pitch = pitch or pixels
    ends = {0: (-side / 2, -gap / 2), 1: (gap / 2, side / 2)}
    bars = [
        [
            bar(pixels, ends[n][0] + shift[..., axis], ends[n][1] + shift[..., axis], blur)
            for n in (0, 1)
        ]
        for axis in (0, 1)
    ]
    cells = np.stack(
        [bars[0][r][..., :, None] * bars[1][c][..., None, :] for r, c in CELLS], axis=-1
    )
    # of the light over the pupil
    place = (np.arange(pixels) + 0.5 - pixels / 2 - shift[..., 1, None]) / pitch
    slope = 1 - fall * (place[..., None, :, None] + 0.5) * np.linspace(0.3, 1, 4)
    if kind == "cells":
        mixed = (1 - leak) * cells + leak / 3 * (cells.sum(axis=-1, keepdims=True) - cells)
    else:
        rows, columns = (
            bar(pixels, -pitch / 2 + shift[..., axis], pitch / 2 + shift[..., axis], blur)
            for axis in (0, 1)
        )
        whole = rows[..., :, None] * columns[..., None, :]
        mixed = (1 - leak) * cells + leak / 4 * whole[..., None]
    return (mixed * slope).reshape(*shift.shape[:-1], pixels * pixels, 4)
