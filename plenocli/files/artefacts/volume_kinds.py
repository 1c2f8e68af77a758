"""The tables of volumes: their kernels, and what was seen with them."""

from plenocli.files.artefacts.schema import Schema, attribute, dataset

_GRID = (
    dataset(
        "volume/depth",
        "plane",
        "f",
        "m",
        "of each plane from the focused one, away from the objective; of a photographic camera "
        "from its main lens",
        ascending=True,
    ),
    dataset(
        "volume/spacing",
        "plane 2",
        "f",
        "m",
        "between voxels (rows, columns)",
        minimum=0,
    ),
)

PIF_STACK = Schema(
    kind="pif-stack",
    version=1,
    doc=(
        "Kernels of a volume before lenslets, A(z), the same for all lenslets: entry by entry "
        "where the light of the voxels of one plane over one lenslet lands on one superpixel."
    ),
    fields=(
        dataset(
            "stack/A",
            "entry pixel point",
            "f",
            "1",
            "share of a voxel's light through the pupil that lands on a pixel",
            minimum=0,
            compress=False,
        ),
        dataset(
            "stack/plane",
            "entry",
            "i",
            "1",
            "number of the plane, from 0, never falling",
            minimum=0,
        ),
        dataset(
            "stack/lenslet_offset",
            "entry 2",
            "i",
            "1",
            "superpixel (row, column) relative to the voxel's own lenslet",
        ),
        dataset(
            "stack/depth",
            "plane",
            "f",
            "m",
            "of each plane from the focused one, away from the objective; of a photographic camera "
            "from its main lens",
            ascending=True,
        ),
        dataset("stack/spacing", "plane 2", "f", "m", "between voxels (rows, columns)", minimum=0),
        dataset("stack/wavelength", "1", "f", "m", "of the light", minimum=0),
        dataset("stack/pixel_shape", "2", "i", "1", "pixels of a superpixel", minimum=1),
        dataset("stack/point_shape", "2", "i", "1", "voxels of a lenslet", minimum=1),
        dataset(
            "stack/column_energy",
            "plane point",
            "f",
            "1",
            "share of a voxel's light on the superpixels kept",
            minimum=0,
        ),
    ),
    plots={"stack": ("column_energy", ())},
    default=("stack",),
)

VOLUME = Schema(
    kind="volume",
    version=1,
    doc=(
        "A volume, made from a capture or given to one: rows and columns go as those of the "
        "sensor, depth away from the objective."
    ),
    fields=(
        dataset(
            "volume/value",
            "plane point_row point_column",
            "f",
            "1",
            "light of each voxel, in units of the capture",
        ),
        dataset(
            "volume/sigma",
            "plane point_row point_column",
            "f",
            "1",
            "standard deviation of the error that is expected of each voxel",
            optional=True,
            minimum=0,
        ),
        dataset(
            "volume/opacity",
            "plane point_row point_column",
            "f",
            "1",
            "of opaque layers, the nearest first: what of the light behind them each voxel hides",
            optional=True,
            minimum=0,
        ),
        *_GRID,
        dataset(
            "held_out/index",
            "sample 3",
            "i",
            "1",
            "pixels that were put aside: lenslet row, lenslet column, pixel",
            optional=True,
            minimum=0,
        ),
        dataset("held_out/measured", "sample", "f", "1", "what they measured", optional=True),
        dataset(
            "held_out/predicted", "sample", "f", "1", "what the volume makes of them", optional=True
        ),
        dataset(
            "held_out/sigma",
            "sample",
            "f",
            "1",
            "standard deviation of the difference that is expected",
            optional=True,
            minimum=0,
        ),
    ),
    attrs={
        "volume": (
            attribute("method", "text", "", "that made it"),
            attribute("trace", "json", "", "what was tried, and its error at held-out pixels"),
            attribute("background", "number", "1", "light that was taken for none of the volume's"),
            attribute("correlation_length", "number", "m", "of the prior"),
            attribute("prior_variance", "number", "1", "of a voxel in the prior"),
            attribute("noise_variance", "number", "1", "of a pixel, model error included"),
            attribute("margin", "number", "1", "lenslets from the border where light is missing"),
            attribute("point_shape", "number", "1", "voxels of a lenslet (rows, columns)"),
        ),
        "held_out": (
            attribute("explained_db", "number", "dB", "of the variance of the held-out pixels"),
            attribute(
                "z_rms", "number", "1", "error over sigma by quartile of brightness, darkest first"
            ),
            attribute(
                "held_by_bars", "number", "1", "share within 95 % bars by quartile of brightness"
            ),
        ),
    },
    plots={"volume": ("value", ("sigma",))},
    default=("volume",),
)
