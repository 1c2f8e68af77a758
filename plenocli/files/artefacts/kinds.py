"""The tables: what a system matrix, a capture, a calibration, spectra, a dictionary and
an image file hold.

Pixels, points and lenslets are numbered row by row, rows downwards; positions are (row, column),
pixel centres at integers.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from plenocli.files.artefacts.schema import Schema, attribute, dataset
from plenocli.files.artefacts.volume_kinds import PIF_STACK, VOLUME

_NOTES = attribute("notes", "json", "", "anything else worth keeping")

_PIF_FIELDS = (
    dataset("pif/wavelength", "band", "f", "m", "centre wavelength", minimum=0, ascending=True),
    dataset(
        "pif/lenslet_offset",
        "lenslet 2",
        "i",
        "1",
        (
            "superpixel (row, column) relative to the object's own lenslet; axial numbers "
            "on a hexagonal lattice"
        ),
    ),
    dataset("pif/pixel_shape", "2", "i", "1", "pixels of a superpixel (rows, columns)", minimum=1),
    dataset(
        "pif/object_shape",
        "2",
        "i",
        "1",
        "object points over one lenslet's field (rows, columns)",
        minimum=1,
    ),
    dataset(
        "pif/column_energy",
        "band point",
        "f",
        "1",
        "share of a point's light that lands on the superpixels kept",
        minimum=0,
    ),
    dataset(
        "pif/singular_values",
        "band value | value",
        "f",
        "1",
        "singular values of A, largest first",
        optional=True,
        minimum=0,
    ),
)
_PIF_ATTRS = (
    attribute("rank", "number", "1", "singular values above the resolution, one a band"),
    attribute(
        "condition",
        "number",
        "1",
        (
            "largest over smallest singular value, one a band; a lower bound where it is the "
            "inverse of the resolution"
        ),
        finite=False,
    ),
    attribute(
        "resolution",
        "number",
        "1",
        (
            "share of the largest singular value below which others are rounding of the numbers "
            "that A is stored in, one a band"
        ),
    ),
    attribute(
        "symmetry_defect",
        "number",
        "1",
        (
            "relative difference of A and A with the object turned by 180 degrees; 0: "
            "half of it is invisible"
        ),
    ),
    attribute(
        "coherent_ring",
        "number",
        "1",
        (
            "rings of lenslets beyond the superpixels kept and the blur whose fields are summed "
            "too; 0: isolated lenslet"
        ),
    ),
    attribute(
        "kappa",
        "number",
        "1/m",
        "quadratic phase left on the lenslet after sensor distance and lenslet focal length",
    ),
    attribute("eps", "number", "1/m", "defocus of the main lens"),
    attribute("superpixel_pitch", "number", "m", "spacing of superpixel centres on the sensor"),
    attribute("model", "text", "", "propagation model"),
    attribute(
        "lattice",
        "text",
        "",
        "of the lenslets: square (if left out) or hexagonal",
        pattern="square|hexagonal",
    ),
    _NOTES,
)


PIF = Schema(
    kind="pif",
    version=1,
    doc="Pupil image functions: the system matrix A of a camera, one matrix a band and superpixel.",
    fields=(
        dataset(
            "pif/A",
            "band lenslet pixel point",
            "f",
            "1",
            minimum=0,
            compress=False,
            doc=(
                "fraction of the light through the main pupil from an object point that lands in a "
                "pixel of a superpixel"
            ),
        ),
        *_PIF_FIELDS,
    ),
    attrs={"pif": _PIF_ATTRS},
    plots={"pif": ("A", ())},
    default=("pif",),
)

PIF_INDEX = Schema(
    kind="pif-index",
    version=1,
    doc=(
        "A system matrix too large for one file: what `pif` holds but for A, which is in numbered "
        "files of kind pif beside it."
    ),
    fields=(
        *_PIF_FIELDS,
        dataset(
            "pif/shard",
            "lenslet",
            "i",
            "1",
            "which of the files holds the superpixel, counted from 0; there it has the same offset",
            minimum=0,
        ),
    ),
    attrs={"pif": (*_PIF_ATTRS, attribute("shards", "json", "", "name and SHA-256 of each file"))},
    plots={"pif": ("column_energy", ())},
    default=("pif",),
)

PIF_PLANES = Schema(
    kind="pif-planes",
    version=1,
    doc=(
        "System matrices of a scene's depth: one file of kind pif (or pif-index) a plane beside "
        "it, each with its own superpixels; between planes they are interpolated in 1/distance."
    ),
    fields=(
        dataset(
            "planes/distance",
            "plane",
            "f",
            "m",
            "distance of each plane to the main lens",
            minimum=0,
            ascending=True,
        ),
    ),
    attrs={
        "planes": (
            attribute("files", "json", "", "name and SHA-256 of each plane's file"),
            attribute("error", "number", "1", "relative L2 error of the worst column in between"),
        )
    },
)

PIF_FIELD = Schema(
    kind="pif-field",
    version=1,
    doc=(
        "System matrices of a whole array: one file of kind pif (or pif-index) beside it for each "
        "of some places of the field; those of lenslets in between are interpolated."
    ),
    fields=(
        dataset(
            "field/row",
            "row_node",
            "f",
            "m",
            "rows of places on the array, from the optical axis",
            ascending=True,
        ),
        dataset(
            "field/column",
            "column_node",
            "f",
            "m",
            "columns of places on the array, from the optical axis",
            ascending=True,
        ),
        dataset(
            "field/file",
            "row_node column_node",
            "i",
            "1",
            "which of the files serves a place, counted from 0",
            minimum=0,
        ),
        dataset(
            "field/turn",
            "row_node column_node 3",
            "b",
            "",
            (
                "how its matrix is turned for that place: rows and columns exchanged, then rows "
                "turned over, columns turned over, of superpixels, pixels and points alike"
            ),
        ),
    ),
    attrs={
        "field": (
            attribute("files", "json", "", "name and SHA-256 of each file"),
            attribute("error", "number", "1", "relative L2 error of the worst column in between"),
        )
    },
)

CAPTURE = Schema(
    kind="capture",
    version=1,
    doc="One exposure of a plenoptic camera, simulated or measured.",
    fields=(
        dataset(
            "capture/mosaic",
            "row column",
            "i f",
            "see units",
            "sensor values as read out",
            maskable=False,
        ),
        dataset(
            "capture/cfa",
            "2 2 |",
            "S",
            "",
            "2x2 letters of the colour filter array, or the text mono",
        ),
        dataset(
            "capture/lenslet_centre",
            "lenslet_row lenslet_column 2",
            "f",
            "px",
            "true superpixel centres",
            optional=True,
        ),
        dataset(
            "capture/scene",
            "band scene_row scene_column",
            "f",
            "1",
            "the object as sampled",
            optional=True,
        ),
        dataset(
            "capture/wavelength",
            "band",
            "f",
            "m",
            "wavelengths of capture/scene",
            optional=True,
            minimum=0,
            ascending=True,
        ),
        dataset(
            "capture/polarisation",
            "scene_row scene_column",
            "f",
            "1",
            "degree of linear polarisation of capture/scene, from -1 (90 degrees) to 1 (0 degrees)",
            optional=True,
            minimum=-1,
        ),
    ),
    attrs={
        "capture": (
            attribute(
                "units",
                "text",
                "",
                (
                    "DN, electron, or relative: 1 is the light of a white object point "
                    "through the clear pupil"
                ),
            ),
            attribute(
                "electrons_per_unit",
                "number",
                "e",
                "electrons for one unit of A x",
                minimum=0,
                size=1,
            ),
            attribute(
                "black", "number", "units", "level of no light: one number, or 2x2 by position"
            ),
            attribute("white", "number", "units", "saturation level", finite=False),
            attribute(
                "gain_e_per_dn", "number", "e/DN", "electrons for one DN", minimum=1e-30, size=1
            ),
            attribute("exposure_s", "number", "s", "exposure time", minimum=0, size=1),
            attribute(
                "band_m",
                "number",
                "m",
                "centre of the narrow band that lit the scene",
                minimum=0,
                size=1,
            ),
            attribute(
                "snr_db", "number", "dB", "signal-to-noise ratio asked for", finite=False, size=1
            ),
            attribute(
                "noise_sigma",
                "number",
                "units",
                "standard deviation of the added noise",
                minimum=0,
                size=1,
            ),
            attribute(
                "lenslet_count", "number", "1", "lenslets (rows, columns)", minimum=1, size=2
            ),
            attribute(
                "superpixel_shape",
                "number",
                "px",
                "pixels of a superpixel (rows, columns)",
                minimum=1,
                size=2,
            ),
            attribute(
                "superpixel_pitch", "number", "px", "spacing of superpixel centres (rows, columns)"
            ),
            attribute("pixel_phase", "number", "px", "position of the first superpixel centre"),
            attribute(
                "scene_shape", "number", "1", "object points (rows, columns)", minimum=1, size=2
            ),
            attribute("target", "text", "", "what was in front of the camera"),
            attribute("illuminant", "text", "", "name of the light"),
            attribute("camera", "text", "", "camera make and model"),
            attribute(
                "to_rgb",
                "number",
                "1",
                "linear sRGB of the camera's R, G and B over those of white, 3 x 3 row by row",
                size=9,
            ),
            attribute(
                "neutral",
                "number",
                "1",
                "R, G and B of white, the largest is 1",
                minimum=1e-30,
                size=3,
            ),
            _NOTES,
        )
    },
    plots={"capture": ("mosaic", ())},
    default=("capture",),
)


def _lit_lenslets(data: Mapping[str, np.ndarray]) -> str | None:
    valid = data["grid/valid"].astype(bool)
    if not valid.any():
        return "no lenslet of 'grid/valid' is lit"
    if not np.isfinite(data["grid/centre"][valid]).all():
        return "lenslets of 'grid/valid' have no 'grid/centre'"
    return None


def _whole_response(data: Mapping[str, np.ndarray]) -> str | None:
    for name, needed in (
        ("response/F", "response/wavelength"),
        ("response/F", "response/window"),
        ("response/window", "response/origin"),
        ("response/origin", "response/window"),
        ("response/polarised", "response/F"),
    ):
        if name in data and needed not in data:
            return f"'{name}' lacks '{needed}'"
    if "response/F" in data:
        known = np.abs(data["response/F"][np.isfinite(data["response/F"])])
        largest = float(known.max()) if known.size else np.inf
        if largest and not 1e-30 <= largest <= 1e30:  # radiances are single precision
            return f"'response/F' has no value that counts, or values up to {largest:.3g}"
    return None


CALIBRATION = Schema(
    kind="calibration",
    version=1,
    doc="Lenslet grid, white and dark levels and response of a camera, measured or predicted.",
    fields=(
        dataset(
            "grid/centre",
            "lenslet_row lenslet_column 2",
            "f",
            "px",
            "centre of each superpixel, row then column",
            maskable=True,
        ),
        dataset(
            "grid/valid",
            "lenslet_row lenslet_column",
            "b",
            "1",
            "superpixel lies wholly on the sensor and is lit",
        ),
        dataset(
            "grid/residual",
            "lenslet_row lenslet_column",
            "f",
            "px",
            "distance of the measured centre from the lattice",
            optional=True,
            maskable=True,
        ),
        dataset(
            "white/flat",
            "row column",
            "f",
            "1",
            "white image minus dark, peak 1 in each superpixel",
            optional=True,
            maskable=True,
        ),
        dataset(
            "white/level",
            "lenslet_row lenslet_column",
            "f",
            "DN",
            "peak of the white image by superpixel",
            optional=True,
            maskable=True,
        ),
        dataset(
            "dark/mean",
            "dark_row dark_column |",
            "f",
            "DN",
            "dark image, or its mean",
            optional=True,
            maskable=True,
        ),
        dataset(
            "response/F",
            "lenslet_row lenslet_column pixel band | pixel band",
            "f",
            "DN",
            optional=True,
            maskable=True,
            doc=(
                "signal of each pixel for unit relative radiance in a band; shared by all lenslets "
                "where two-dimensional"
            ),
        ),
        dataset(
            "response/origin",
            "lenslet_row lenslet_column 2",
            "i",
            "px",
            "first pixel (row, column) of each superpixel window",
            optional=True,
        ),
        dataset(
            "response/window",
            "2",
            "i",
            "px",
            "rows and columns of the window",
            optional=True,
            minimum=1,
        ),
        dataset(
            "response/covariance",
            "pixel band | band | lenslet_row lenslet_column pixel band",
            "f",
            "DN^2",
            "variance of F",
            optional=True,
            maskable=True,
            minimum=0,
        ),
        dataset(
            "response/polarised",
            "lenslet_row lenslet_column pixel band | pixel band",
            "f",
            "DN",
            "what F has more of light along 0 degrees, and less of light along 90 degrees",
            optional=True,
            maskable=True,
        ),
        dataset(
            "response/wavelength",
            "band",
            "f",
            "m",
            "band centres",
            optional=True,
            minimum=0,
            ascending=True,
        ),
        dataset(
            "response/white",
            "lenslet_row lenslet_column pixel | pixel",
            "f",
            "DN",
            "mean of the white reference",
            optional=True,
            maskable=True,
        ),
        dataset(
            "response/energy",
            "band",
            "f",
            "1",
            "relative light of each narrow-band exposure",
            optional=True,
            minimum=0,
        ),
    ),
    attrs={
        "grid": (
            attribute("lattice", "text", "", "square or hexagonal", pattern="square|hexagonal"),
            attribute(
                "pitch",
                "number",
                "px",
                "lenslet spacing along rows of the lattice and across them (row, column)",
            ),
            attribute("angle", "number", "deg", "rotation of the lattice"),
            attribute("offset", "number", "px", "centre of lenslet (0, 0)"),
            attribute("rms", "number", "px", "root mean square of the residuals"),
            attribute(
                "expected_error",
                "number",
                "px",
                "by which the centres may be off (rms), of a grid from captures of a scene",
                minimum=0,
                size=1,
            ),
            attribute("lenslets", "number", "1", "valid lenslets"),
            attribute("model", "json", "", "coefficients of the lattice fit"),
            _NOTES,
        ),
        "white": (
            attribute(
                "exposure", "number", "s", "exposure time of the white image", minimum=0, size=1
            ),
            attribute(
                "gain_e_per_dn", "number", "e/DN", "electrons for one DN", minimum=1e-30, size=1
            ),
            attribute("read_noise", "number", "DN", "noise of a dark pixel", minimum=0, size=1),
            attribute("cfa", "text", "", "mono or four letters", pattern="mono|[RGB]{4}"),
            attribute("black", "number", "DN", "level of no light: one number, or 2x2 by position"),
            attribute("white", "number", "DN", "saturation level", finite=False),
            _NOTES,
        ),
        "dark": (
            attribute(
                "exposure", "number", "s", "exposure time of the dark image", minimum=0, size=1
            ),
            attribute("sigma", "number", "DN", "noise of a dark pixel", minimum=0, size=1),
            _NOTES,
        ),
        "response": (
            attribute("single_pixel", "number", "1", "pixel of the window chosen for each band"),
            attribute("condition", "number", "1", "median condition number of F", finite=False),
            attribute(
                "angles",
                "json",
                "deg",
                "median angles between the columns of F, (band, band); 90 is perfect separation",
            ),
            attribute(
                "bias",
                "number",
                "1",
                (
                    "share by which the noise of F itself changes least-squares radiances, by band "
                    "(errors in variables)"
                ),
            ),
            attribute("read_noise", "number", "DN", "noise of a dark pixel", minimum=0, size=1),
            attribute(
                "gain_e_per_dn", "number", "e/DN", "electrons for one DN", minimum=1e-30, size=1
            ),
            attribute("cfa", "text", "", "mono or four letters", pattern="mono|[RGB]{4}"),
            attribute("units", "text", "", "DN or electron"),
            attribute("exposure_s", "number", "s", "exposure to which F refers", minimum=0, size=1),
            _NOTES,
        ),
    },
    plots={
        "grid": ("residual", ()),
        "white": ("flat", ()),
        "response": ("F", ()),
        "dark": ("mean", ()),
    },
    rules=(_lit_lenslets, _whole_response),
    default=("response", "white", "grid"),
)

SPECTRA = Schema(
    kind="spectra",
    version=1,
    doc="Spectrum behind each lenslet.",
    fields=(
        dataset(
            "spectra/value",
            "band lenslet_row lenslet_column",
            "f",
            "1",
            "recovered radiance or reflectance",
            maskable=True,
        ),
        dataset(
            "spectra/sigma",
            "band lenslet_row lenslet_column",
            "f",
            "1",
            "predicted standard deviation",
            optional=True,
            maskable=True,
            minimum=0,
        ),
        dataset(
            "spectra/residual",
            "lenslet_row lenslet_column",
            "f",
            "1",
            "mean square of what F b leaves of a superpixel over its noise; 1 is noise alone",
            optional=True,
            maskable=True,
            minimum=0,
        ),
        dataset(
            "spectra/s1",
            "band lenslet_row lenslet_column",
            "f",
            "1",
            "Stokes parameter s1, where spectra/value is s0: light along 0 less that along 90 "
            "degrees",
            optional=True,
            maskable=True,
        ),
        dataset(
            "spectra/s1_sigma",
            "band lenslet_row lenslet_column",
            "f",
            "1",
            "predicted standard deviation of s1",
            optional=True,
            maskable=True,
            minimum=0,
        ),
        dataset("spectra/wavelength", "band", "f", "m", "band centres", minimum=0, ascending=True),
    ),
    attrs={
        "spectra": (
            attribute("quantity", "text", "", "radiance or reflectance"),
            attribute("method", "text", "", "how it was computed"),
            attribute("reference", "text", "", "white reference, file name"),
            attribute("parameters", "json", "", "settings of the method"),
            _NOTES,
        )
    },
    plots={"spectra": ("value", ("sigma",))},
    default=("spectra",),
)

DICTIONARY = Schema(
    kind="dictionary",
    version=1,
    doc="Dictionary of object patches learnt for one system matrix.",
    fields=(
        dataset("dictionary/atoms", "point atom", "f", "1", "patches, unit norm, one a column"),
        dataset(
            "dictionary/synthesis",
            "point atom",
            "f",
            "1",
            "what paints the coefficients found with the atoms, if not the atoms",
            optional=True,
        ),
        dataset(
            "dictionary/history/*",
            None,
            "f i b",
            "see name",
            "value after each iteration",
            maskable=True,
        ),
        dataset(
            "dictionary/state/*",
            None,
            "f i b",
            "see name",
            "what a resumed run needs",
            maskable=True,
        ),
    ),
    attrs={
        "dictionary": (
            attribute(
                "delta",
                "number",
                "1",
                "weight of the term that keeps A times the atoms small",
                minimum=0,
                size=1,
            ),
            attribute("lambda", "number", "1", "weight of the l1 term", minimum=0, size=1),
            attribute(
                "coherence_mutual", "number", "1", "largest |cosine| between a row of A and an atom"
            ),
            attribute(
                "coherence_effective",
                "number",
                "1",
                "largest |cosine| between two columns of A times the atoms",
            ),
            attribute(
                "coherence_average",
                "number",
                "1",
                "mean |cosine| between columns of A times the atoms",
            ),
            attribute(
                "coherence_raw",
                "number",
                "1",
                "largest |inner product| of a row of A and an atom, not normalised",
            ),
            attribute("coherence_welch", "number", "1", "lower bound of the effective coherence"),
            attribute("coherence", "json", "", "all coherence measures"),
            attribute(
                "object_shape",
                "number",
                "1",
                "points of an atom (rows, columns)",
                minimum=1,
                size=2,
            ),
            attribute("iterations", "number", "1", "iterations done", minimum=0, size=1),
            attribute(
                "scale",
                "number",
                "1",
                "factor by which A was divided before learning",
                minimum=1e-30,
                size=1,
            ),
            attribute("parameters", "json", "", "settings of the method"),
            attribute("random_state", "json", "", "state of the random numbers for a resumed run"),
            _NOTES,
        )
    },
    plots={"dictionary": ("atoms", ())},
    default=("dictionary",),
)

CHECKPOINT = replace(
    DICTIONARY, kind="checkpoint", doc="A dictionary that is still being learnt (--checkpoint)."
)

IMAGE = Schema(
    kind="image",
    version=1,
    doc="Reconstructed picture, linear.",
    fields=(
        dataset("image/value", "row column | band row column", "f", "1", "relative radiance"),
        dataset(
            "image/sigma",
            "row column | band row column",
            "f",
            "1",
            "predicted standard deviation: 1.96 of it each way hold the truth at 95 % of points",
            optional=True,
            minimum=0,
        ),
        dataset(
            "image/seen",
            "object_row object_column",
            "f",
            "1",
            (
                "share of each object point of a lenslet that the sensor tells apart at the "
                "capture's noise; 0 in the null space"
            ),
            optional=True,
            minimum=0,
        ),
        dataset(
            "image/rgb",
            "3 row column",
            "f",
            "1",
            "the same in colour where the capture's pixels have colours, linear sRGB",
            optional=True,
        ),
        dataset(
            "image/wavelength",
            "band",
            "f",
            "m",
            "band centres",
            optional=True,
            minimum=0,
            ascending=True,
        ),
    ),
    attrs={
        "image": (
            attribute("method", "text", "", "how it was computed"),
            attribute("parameters", "json", "", "settings of the method"),
            attribute(
                "clipped",
                "number",
                "1",
                "share of points set to zero because they came out negative",
            ),
            _NOTES,
        )
    },
    plots={"image": ("value", ("sigma",))},
    default=("image",),
)

SWEEP = Schema(
    kind="sweep",
    version=1,
    doc="Points of a design space, what each gave, and which of them no other beats.",
    fields=(
        dataset(
            "sweep/parameter",
            "point parameter",
            "f",
            "see parameters",
            "value of each key that varies; for one with choices its place in their list",
            maskable=True,
        ),
        dataset(
            "sweep/metric",
            "point metric",
            "f",
            "see metrics",
            "figures of each point; NaN where there is none",
            optional=True,
            maskable=True,
        ),
        dataset(
            "sweep/status",
            "point",
            "i",
            "1",
            (
                "exit code that the stages would have given: 0 done, 2 no such camera, 5 "
                "numerically impossible"
            ),
            minimum=0,
        ),
        dataset(
            "sweep/front",
            "point",
            "b",
            "1",
            "no other point is at least as good in all objectives and better in one",
        ),
        dataset("sweep/key", "point", "S", "", "SHA-256 of all that a point's figures depend on"),
    ),
    attrs={
        "sweep": (
            attribute(
                "chain", "text", "", "stages that each point went through: spatial or spectral"
            ),
            attribute(
                "parameters",
                "json",
                "",
                "columns of parameter: key, unit, and choices where it has no number",
            ),
            attribute("metrics", "json", "", "columns of metric: name and meaning"),
            attribute(
                "objectives",
                "json",
                "",
                "what the front compares: pairs of a metric or key, and max or min",
            ),
            attribute("reasons", "json", "", "point -> why a stage refused it"),
            attribute("notes", "json", "", "point -> what the stages said beside their results"),
            attribute("description", "json", "", "the sweep file"),
        )
    },
    plots={"sweep": ("metric", ())},
    default=("sweep",),
)

LIGHTFIELD = Schema(
    kind="lightfield",
    version=1,
    doc=(
        "One capture focused on several planes, its depth, and its views through parts of "
        "the pupil."
    ),
    fields=(
        dataset(
            "refocus/value",
            "plane point_row point_column",
            "f",
            "1",
            "radiance relative to white, `step` points a lenslet pitch",
            maskable=True,
        ),
        dataset(
            "refocus/slope",
            "plane",
            "f",
            "1",
            "px that a plane's picture moves for each px of view; 0 is focused on the lenslets",
            ascending=True,
        ),
        dataset(
            "refocus/distance",
            "plane",
            "f",
            "m",
            "of each plane in front of the main lens, NaN beyond infinity; of a microscope its "
            "depth, from the plane focused on the lenslets away from the objective",
            optional=True,
            maskable=True,
        ),
        dataset(
            "refocus/sharpness",
            "plane",
            "f",
            "1",
            "mean square gradient of each picture",
            minimum=0,
        ),
        dataset(
            "depth/slope",
            "row column",
            "f",
            "1",
            "slope at which the views agree best, one point a lenslet pitch",
            optional=True,
            maskable=True,
        ),
        dataset(
            "depth/distance",
            "row column",
            "f",
            "m",
            "the same as a distance",
            optional=True,
            maskable=True,
        ),
        dataset(
            "depth/confidence",
            "row column",
            "f",
            "1",
            "probability that the slope is right within 1; 0 where nothing is known",
            optional=True,
            minimum=0,
        ),
        dataset(
            "depth/sigma",
            "row column",
            "f",
            "1",
            "standard deviation of the slope",
            optional=True,
            maskable=True,
            minimum=0,
        ),
        dataset(
            "depth/distance_sigma",
            "row column",
            "f",
            "m",
            "standard deviation of the distance",
            optional=True,
            maskable=True,
            minimum=0,
        ),
        dataset(
            "depth/edge",
            "row column",
            "b",
            "1",
            "where slopes around differ by 1 or more: one thing hides another, depths are mixtures",
            optional=True,
        ),
        dataset(
            "depth/picture",
            "point_row point_column",
            "f",
            "1",
            "everything in focus: each lenslet at its own slope, or at the nearest known one",
            optional=True,
            maskable=True,
        ),
        dataset(
            "views/value",
            "view_row view_column row column",
            "f",
            "1",
            "picture through each part of the pupil",
            optional=True,
            maskable=True,
        ),
        dataset(
            "colour/value",
            "plane channel point_row point_column",
            "f",
            "1",
            "of a capture in colour: what `refocus/value` is the mean of, each over that of white",
            optional=True,
            maskable=True,
        ),
        dataset(
            "colour/picture",
            "channel point_row point_column",
            "f",
            "1",
            "everything in focus",
            optional=True,
            maskable=True,
        ),
        dataset(
            "colour/views",
            "view_row view_column channel row column",
            "f",
            "1",
            "picture through each part of the pupil; NaN where a channel sees nothing through it",
            optional=True,
            maskable=True,
        ),
        dataset(
            "colour/to_rgb", "3 channel", "f", "1", "linear sRGB of the channels", optional=True
        ),
        dataset(
            "colour/weight",
            "channel",
            "f",
            "1",
            "share of the light of white that each channel has",
            optional=True,
            minimum=0,
        ),
        dataset(
            "colour/wavelength",
            "channel",
            "f",
            "m",
            "of bands of a demultiplexed capture",
            optional=True,
            minimum=0,
        ),
    ),
    attrs={
        "colour": (attribute("channels", "json", "", "names of the channels"), _NOTES),
        "refocus": (
            attribute("pitch", "number", "px", "lenslet spacing"),
            attribute("step", "number", "1", "points of a picture per pitch"),
            attribute("pupil", "number", "px", "width of the pupil's image"),
            attribute(
                "spacing",
                "number",
                "m",
                "of lenslets as seen on the plane focused on them",
                minimum=0,
            ),
            attribute("microscope", "json", "", "whether distances are depths before an objective"),
            _NOTES,
        ),
    },
    plots={
        "refocus": ("value", ()),
        "depth": ("slope", ("distance", "confidence", "sigma")),
        "views": ("value", ()),
    },
    default=("refocus",),
)

FIT = Schema(
    kind="fit",
    version=1,
    doc="A camera fitted to its own captures: its parameters and how sure they are.",
    fields=(
        dataset("fit/value", "parameter", "f", "see units", "after the fit"),
        dataset("fit/sigma", "parameter", "f", "see units", "standard deviation", minimum=0),
        dataset("fit/described", "parameter", "f", "see units", "before the fit"),
        dataset(
            "fit/tolerance",
            "parameter",
            "f",
            "see units",
            "standard deviation of what was believed before",
            minimum=0,
        ),
        dataset("fit/correlation", "parameter parameter", "f", "1", "of the errors that are left"),
    ),
    attrs={
        "fit": (
            attribute("names", "json", "", "of the parameters"),
            attribute("units", "json", "", "of the parameters: m or px"),
            attribute("inseparable", "json", "", "pairs that captures do not tell apart"),
            attribute("noise_ratio", "number", "1", "most likely noise over the noise told"),
            attribute("noise_ratio_before", "number", "1", "the same for the camera as described"),
            attribute(
                "model_error", "number", "1", "relative error of the matrix that is still expected"
            ),
            attribute(
                "turned",
                "number",
                "1",
                "steps over lenslet borders with objects turned by 180 degrees, over the others",
            ),
            attribute("lenslets", "number", "1", "looked at"),
            _NOTES,
        )
    },
    plots={"fit": ("correlation", ())},
    default=("fit",),
)

SCHEMAS = {
    schema.kind: schema
    for schema in (
        PIF,
        PIF_INDEX,
        PIF_PLANES,
        PIF_FIELD,
        CAPTURE,
        CALIBRATION,
        SPECTRA,
        DICTIONARY,
        CHECKPOINT,
        IMAGE,
        SWEEP,
        LIGHTFIELD,
        FIT,
        PIF_STACK,
        VOLUME,
    )
}
