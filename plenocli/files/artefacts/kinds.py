"""The tables: what a system matrix, a capture, a calibration, spectra, a dictionary and
an image file hold.

Pixels, points and lenslets are numbered row by row, rows downwards; positions are (row, column),
pixel centres at integers.
"""

from plenocli.files.artefacts.schema import Attr, Field, Schema

_NOTES = Attr("notes", "json", "", "anything else worth keeping")

_PIF_FIELDS = (
    Field("pif/wavelength", "band", "f", "m", "centre wavelength", minimum=0, ascending=True),
    Field(
        "pif/lenslet_offset",
        "lenslet 2",
        "i",
        "1",
        (
            "superpixel (row, column) relative to the object's own lenslet; axial numbers "
            "on a hexagonal lattice"
        ),
    ),
    Field("pif/pixel_shape", "2", "i", "1", "pixels of a superpixel (rows, columns)", minimum=1),
    Field(
        "pif/object_shape",
        "2",
        "i",
        "1",
        "object points over one lenslet's field (rows, columns)",
        minimum=1,
    ),
    Field(
        "pif/column_energy",
        "band point",
        "f",
        "1",
        "share of a point's light that lands on the superpixels kept",
        minimum=0,
    ),
    Field(
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
    Attr("rank", "number", "1", "numerical rank, one a band"),
    Attr(
        "condition", "number", "1", "largest over smallest singular value, one a band", finite=False
    ),
    Attr(
        "symmetry_defect",
        "number",
        "1",
        (
            "relative difference of A and A with the object turned by 180 degrees; 0: "
            "half of it is invisible"
        ),
    ),
    Attr(
        "coherent_ring",
        "number",
        "1",
        "rings of neighbour lenslets whose fields are summed; 0: isolated lenslet",
    ),
    Attr(
        "kappa",
        "number",
        "1/m",
        "quadratic phase left on the lenslet after sensor distance and lenslet focal length",
    ),
    Attr("eps", "number", "1/m", "defocus of the main lens"),
    Attr("superpixel_pitch", "number", "m", "spacing of superpixel centres on the sensor"),
    Attr("model", "text", "", "propagation model"),
    Attr("lattice", "text", "", "of the lenslets: square (if left out) or hexagonal"),
    _NOTES,
)

PIF = Schema(
    "pif",
    1,
    "Pupil image functions: the system matrix A of a camera, one matrix a band and superpixel.",
    (
        Field(
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
    "pif-index",
    1,
    (
        "A system matrix too large for one file: what `pif` holds but for A, which is in numbered "
        "files of kind pif beside it."
    ),
    (
        *_PIF_FIELDS,
        Field(
            "pif/shard",
            "lenslet",
            "i",
            "1",
            "which of the files holds the superpixel, counted from 0; there it has the same offset",
            minimum=0,
        ),
    ),
    attrs={"pif": (*_PIF_ATTRS, Attr("shards", "json", "", "name and SHA-256 of each file"))},
    plots={"pif": ("column_energy", ())},
    default=("pif",),
)

CAPTURE = Schema(
    "capture",
    1,
    "One exposure of a plenoptic camera, simulated or measured.",
    (
        Field(
            "capture/mosaic",
            "row column",
            "i f",
            "see units",
            "sensor values as read out",
            maskable=False,
        ),
        Field(
            "capture/cfa",
            "2 2 |",
            "S",
            "",
            "2x2 letters of the colour filter array, or the text mono",
        ),
        Field(
            "capture/lenslet_centre",
            "lenslet_row lenslet_column 2",
            "f",
            "px",
            "true superpixel centres",
            optional=True,
        ),
        Field(
            "capture/scene",
            "band scene_row scene_column",
            "f",
            "1",
            "the object as sampled",
            optional=True,
        ),
        Field(
            "capture/wavelength",
            "band",
            "f",
            "m",
            "wavelengths of capture/scene",
            optional=True,
            minimum=0,
            ascending=True,
        ),
    ),
    attrs={
        "capture": (
            Attr(
                "units",
                "text",
                "",
                (
                    "DN, electron, or relative: 1 is the light of a white object point "
                    "through the clear pupil"
                ),
            ),
            Attr("electrons_per_unit", "number", "e", "electrons for one unit of A x"),
            Attr("black", "number", "units", "level of no light: one number, or 2x2 by position"),
            Attr("white", "number", "units", "saturation level", finite=False),
            Attr("gain_e_per_dn", "number", "e/DN", "electrons for one DN"),
            Attr("exposure_s", "number", "s", "exposure time"),
            Attr("band_m", "number", "m", "centre of the narrow band that lit the scene"),
            Attr("snr_db", "number", "dB", "signal-to-noise ratio asked for", finite=False),
            Attr("noise_sigma", "number", "units", "standard deviation of the added noise"),
            Attr("lenslet_count", "number", "1", "lenslets (rows, columns)"),
            Attr("superpixel_shape", "number", "px", "pixels of a superpixel (rows, columns)"),
            Attr(
                "superpixel_pitch", "number", "px", "spacing of superpixel centres (rows, columns)"
            ),
            Attr("pixel_phase", "number", "px", "position of the first superpixel centre"),
            Attr("scene_shape", "number", "1", "object points (rows, columns)"),
            Attr("target", "text", "", "what was in front of the camera"),
            Attr("illuminant", "text", "", "name of the light"),
            Attr("camera", "text", "", "camera make and model"),
            _NOTES,
        )
    },
    plots={"capture": ("mosaic", ())},
    default=("capture",),
)

CALIBRATION = Schema(
    "calibration",
    1,
    "Lenslet grid, white and dark levels and response of a camera, measured or predicted.",
    (
        Field(
            "grid/centre",
            "lenslet_row lenslet_column 2",
            "f",
            "px",
            "centre of each superpixel, row then column",
            maskable=True,
        ),
        Field(
            "grid/valid",
            "lenslet_row lenslet_column",
            "b",
            "1",
            "superpixel lies wholly on the sensor and is lit",
        ),
        Field(
            "grid/residual",
            "lenslet_row lenslet_column",
            "f",
            "px",
            "distance of the measured centre from the lattice",
            optional=True,
            maskable=True,
        ),
        Field(
            "white/flat",
            "row column",
            "f",
            "1",
            "white image minus dark, peak 1 in each superpixel",
            optional=True,
            maskable=True,
        ),
        Field(
            "white/level",
            "lenslet_row lenslet_column",
            "f",
            "DN",
            "peak of the white image by superpixel",
            optional=True,
            maskable=True,
        ),
        Field(
            "dark/mean",
            "dark_row dark_column |",
            "f",
            "DN",
            "dark image, or its mean",
            optional=True,
            maskable=True,
        ),
        Field(
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
        Field(
            "response/origin",
            "lenslet_row lenslet_column 2",
            "i",
            "px",
            "first pixel (row, column) of each superpixel window",
            optional=True,
        ),
        Field(
            "response/window",
            "2",
            "i",
            "px",
            "rows and columns of the window",
            optional=True,
            minimum=1,
        ),
        Field(
            "response/covariance",
            "pixel band | band | lenslet_row lenslet_column pixel band",
            "f",
            "DN^2",
            "variance of F",
            optional=True,
            maskable=True,
            minimum=0,
        ),
        Field(
            "response/wavelength",
            "band",
            "f",
            "m",
            "band centres",
            optional=True,
            minimum=0,
            ascending=True,
        ),
        Field(
            "response/white",
            "lenslet_row lenslet_column pixel | pixel",
            "f",
            "DN",
            "mean of the white reference",
            optional=True,
            maskable=True,
        ),
        Field(
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
            Attr("lattice", "text", "", "square or hexagonal"),
            Attr(
                "pitch",
                "number",
                "px",
                "lenslet spacing along rows of the lattice and across them (row, column)",
            ),
            Attr("angle", "number", "deg", "rotation of the lattice"),
            Attr("offset", "number", "px", "centre of lenslet (0, 0)"),
            Attr("rms", "number", "px", "root mean square of the residuals"),
            Attr("lenslets", "number", "1", "valid lenslets"),
            Attr("model", "json", "", "coefficients of the lattice fit"),
            _NOTES,
        ),
        "white": (
            Attr("exposure", "number", "s", "exposure time of the white image"),
            Attr("gain_e_per_dn", "number", "e/DN", "electrons for one DN"),
            Attr("read_noise", "number", "DN", "noise of a dark pixel"),
            Attr("cfa", "text", "", "mono or four letters"),
            Attr("black", "number", "DN", "level of no light: one number, or 2x2 by position"),
            Attr("white", "number", "DN", "saturation level", finite=False),
            _NOTES,
        ),
        "dark": (
            Attr("exposure", "number", "s", "exposure time of the dark image"),
            Attr("sigma", "number", "DN", "noise of a dark pixel"),
            _NOTES,
        ),
        "response": (
            Attr("single_pixel", "number", "1", "pixel of the window chosen for each band"),
            Attr("condition", "number", "1", "median condition number of F", finite=False),
            Attr(
                "angles",
                "json",
                "deg",
                "median angles between the columns of F, (band, band); 90 is perfect separation",
            ),
            Attr(
                "bias",
                "number",
                "1",
                (
                    "share by which the noise of F itself changes least-squares radiances, by band "
                    "(errors in variables)"
                ),
            ),
            Attr("read_noise", "number", "DN", "noise of a dark pixel"),
            Attr("gain_e_per_dn", "number", "e/DN", "electrons for one DN"),
            Attr("cfa", "text", "", "mono or four letters"),
            Attr("units", "text", "", "DN or electron"),
            Attr("exposure_s", "number", "s", "exposure to which F refers"),
            _NOTES,
        ),
    },
    plots={
        "grid": ("residual", ()),
        "white": ("flat", ()),
        "response": ("F", ()),
        "dark": ("mean", ()),
    },
    default=("response", "white", "grid"),
)

SPECTRA = Schema(
    "spectra",
    1,
    "Spectrum behind each lenslet.",
    (
        Field(
            "spectra/value",
            "band lenslet_row lenslet_column",
            "f",
            "1",
            "recovered radiance or reflectance",
            maskable=True,
        ),
        Field(
            "spectra/sigma",
            "band lenslet_row lenslet_column",
            "f",
            "1",
            "predicted standard deviation",
            optional=True,
            maskable=True,
            minimum=0,
        ),
        Field(
            "spectra/residual",
            "lenslet_row lenslet_column",
            "f",
            "1",
            "mean square of what F b leaves of a superpixel over its noise; 1 is noise alone",
            optional=True,
            maskable=True,
            minimum=0,
        ),
        Field("spectra/wavelength", "band", "f", "m", "band centres", minimum=0, ascending=True),
    ),
    attrs={
        "spectra": (
            Attr("quantity", "text", "", "radiance or reflectance"),
            Attr("method", "text", "", "how it was computed"),
            Attr("reference", "text", "", "white reference, file name"),
            Attr("parameters", "json", "", "settings of the method"),
            _NOTES,
        )
    },
    plots={"spectra": ("value", ("sigma",))},
    default=("spectra",),
)

DICTIONARY = Schema(
    "dictionary",
    1,
    "Dictionary of object patches learnt for one system matrix.",
    (
        Field("dictionary/atoms", "point atom", "f", "1", "patches, unit norm, one a column"),
        Field(
            "dictionary/synthesis",
            "point atom",
            "f",
            "1",
            "what paints the coefficients found with the atoms, if not the atoms",
            optional=True,
        ),
        Field(
            "dictionary/history/*",
            None,
            "f i b",
            "see name",
            "value after each iteration",
            maskable=True,
        ),
        Field(
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
            Attr("delta", "number", "1", "weight of the term that keeps A times the atoms small"),
            Attr("lambda", "number", "1", "weight of the l1 term"),
            Attr(
                "coherence_mutual", "number", "1", "largest |cosine| between a row of A and an atom"
            ),
            Attr(
                "coherence_effective",
                "number",
                "1",
                "largest |cosine| between two columns of A times the atoms",
            ),
            Attr(
                "coherence_average",
                "number",
                "1",
                "mean |cosine| between columns of A times the atoms",
            ),
            Attr(
                "coherence_raw",
                "number",
                "1",
                "largest |inner product| of a row of A and an atom, not normalised",
            ),
            Attr("coherence_welch", "number", "1", "lower bound of the effective coherence"),
            Attr("coherence", "json", "", "all coherence measures"),
            Attr("object_shape", "number", "1", "points of an atom (rows, columns)"),
            Attr("iterations", "number", "1", "iterations done"),
            Attr("scale", "number", "1", "factor by which A was divided before learning"),
            Attr("parameters", "json", "", "settings of the method"),
            Attr("random_state", "json", "", "state of the random numbers for a resumed run"),
            _NOTES,
        )
    },
    plots={"dictionary": ("atoms", ())},
    default=("dictionary",),
)

IMAGE = Schema(
    "image",
    1,
    "Reconstructed picture, linear.",
    (
        Field("image/value", "row column | band row column", "f", "1", "relative radiance"),
        Field(
            "image/sigma",
            "row column | band row column",
            "f",
            "1",
            "predicted standard deviation",
            optional=True,
            minimum=0,
        ),
        Field(
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
        Field(
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
            Attr("method", "text", "", "how it was computed"),
            Attr("parameters", "json", "", "settings of the method"),
            Attr(
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
    "sweep",
    1,
    "Points of a design space, what each gave, and which of them no other beats.",
    (
        Field(
            "sweep/parameter",
            "point parameter",
            "f",
            "see parameters",
            "value of each key that varies; for one with choices its place in their list",
            maskable=True,
        ),
        Field(
            "sweep/metric",
            "point metric",
            "f",
            "see metrics",
            "figures of each point; NaN where there is none",
            optional=True,
            maskable=True,
        ),
        Field(
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
        Field(
            "sweep/front",
            "point",
            "b",
            "1",
            "no other point is at least as good in all objectives and better in one",
        ),
        Field("sweep/key", "point", "S", "", "SHA-256 of all that a point's figures depend on"),
    ),
    attrs={
        "sweep": (
            Attr("chain", "text", "", "stages that each point went through: spatial or spectral"),
            Attr(
                "parameters",
                "json",
                "",
                "columns of parameter: key, unit, and choices where it has no number",
            ),
            Attr("metrics", "json", "", "columns of metric: name and meaning"),
            Attr(
                "objectives",
                "json",
                "",
                "what the front compares: pairs of a metric or key, and max or min",
            ),
            Attr("reasons", "json", "", "point -> why a stage refused it"),
            Attr("notes", "json", "", "point -> what the stages said beside their results"),
            Attr("description", "json", "", "the sweep file"),
        )
    },
    plots={"sweep": ("metric", ())},
    default=("sweep",),
)

LIGHTFIELD = Schema(
    "lightfield",
    1,
    "One capture focused on several planes, its depth, and its views through parts of the pupil.",
    (
        Field(
            "refocus/value",
            "plane point_row point_column",
            "f",
            "1",
            "radiance relative to white, `step` points a lenslet pitch",
            maskable=True,
        ),
        Field(
            "refocus/slope",
            "plane",
            "f",
            "1",
            "px that a plane's picture moves for each px of view; 0 is focused on the lenslets",
            ascending=True,
        ),
        Field(
            "refocus/distance",
            "plane",
            "f",
            "m",
            "of each plane in front of the main lens; NaN beyond infinity",
            optional=True,
            maskable=True,
        ),
        Field(
            "refocus/sharpness",
            "plane",
            "f",
            "1",
            "mean square gradient of each picture",
            minimum=0,
        ),
        Field(
            "depth/slope",
            "row column",
            "f",
            "1",
            "slope at which the views agree best, one point a lenslet pitch",
            optional=True,
            maskable=True,
        ),
        Field(
            "depth/distance",
            "row column",
            "f",
            "m",
            "the same as a distance",
            optional=True,
            maskable=True,
        ),
        Field(
            "depth/confidence",
            "row column",
            "f",
            "1",
            "0 where all slopes agree alike, towards 1 where one stands out",
            optional=True,
            minimum=0,
        ),
        Field(
            "views/value",
            "view_row view_column row column",
            "f",
            "1",
            "picture through each part of the pupil",
            optional=True,
            maskable=True,
        ),
    ),
    attrs={
        "refocus": (
            Attr("pitch", "number", "px", "lenslet spacing"),
            Attr("step", "number", "1", "points of a picture per pitch"),
            Attr("pupil", "number", "px", "width of the pupil's image"),
            _NOTES,
        )
    },
    plots={
        "refocus": ("value", ()),
        "depth": ("slope", ("distance", "confidence")),
        "views": ("value", ()),
    },
    default=("refocus",),
)

SCHEMAS = {
    schema.kind: schema
    for schema in (
        PIF,
        PIF_INDEX,
        CAPTURE,
        CALIBRATION,
        SPECTRA,
        DICTIONARY,
        IMAGE,
        SWEEP,
        LIGHTFIELD,
    )
}
