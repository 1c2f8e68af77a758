"""One look for all pictures: figures made without pyplot, drawn by Agg, handed
back as PNG bytes.
"""

import io
from contextlib import contextmanager

import numpy as np

from plenocli.base.errors import UsageError
from plenocli.base.extras import how_to_install

#: Okabe and Ito's palette, told apart with any colour vision, in the order of use.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A5C00", "#555555")
TRUTH = "#1a1a1a"
LIGHT_MAP = "inferno"  # amounts of light, dark is none
LEVEL_MAP = "viridis"  # other positive quantities
SIGN_MAP = "RdBu_r"  # differences, white is none
GRID_LINE = "#56B4E9"
DPI = 130

_STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.labelsize": 8.5,
    "axes.titleweight": "normal",
    "axes.titlepad": 5,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#888888",
    "axes.linewidth": 0.7,
    "axes.labelcolor": "#333333",
    "text.color": "#222222",
    "xtick.color": "#666666",
    "ytick.color": "#666666",
    "xtick.labelcolor": "#444444",
    "ytick.labelcolor": "#444444",
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 3,
    "ytick.major.size": 3,
    "axes.grid": False,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "axes.axisbelow": True,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "figure.constrained_layout.w_pad": 0.07,
    "figure.constrained_layout.wspace": 0.03,
    "image.cmap": LEVEL_MAP,
    "mathtext.default": "regular",
}


class Drawing:
    """A figure under construction; `png` holds its bytes after the `with drawing(...)` block."""

    def __init__(self, figure):
        self.figure, self.png = figure, b""


@contextmanager
def drawing(width, height, layout="constrained"):
    """A Drawing of width x height inches in the house style; rendered when the block ends.

    layout: matplotlib's layout engine; None for figures of many panels, which it would take
        seconds to arrange.
    """
    try:
        import matplotlib
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UsageError(
            "pictures need matplotlib, which is not installed", fix=how_to_install("plot")
        ) from error
    with matplotlib.rc_context({**matplotlib.rcParamsDefault, **_STYLE}):
        made = Drawing(Figure(figsize=(width, height), dpi=DPI, layout=layout))
        FigureCanvasAgg(made.figure)
        yield made
        buffer = io.BytesIO()
        made.figure.savefig(buffer, format="png", metadata={"Software": None})
        made.png = buffer.getvalue()


def show_picture(axes, values, title="", **options):
    """A picture without ticks; a 2-D one as linear light, white at 1, encoded for the
    screen as sRGB is.
    """
    from plenocli.forward.scene.colour import encode_srgb

    values = np.asarray(values, dtype=np.float64)
    if values.ndim == 2:
        options = {"cmap": "gray", "vmin": 0, "vmax": 1} | options
    axes.imshow(encode_srgb(np.nan_to_num(values)), **options)
    bare(axes, title)


def show_map(axes, values, title="", bar="", **options):
    """A map with a colour bar labelled `bar` (quantity and unit)."""
    image = axes.imshow(values, **options)
    bare(axes, title)
    colour_bar(axes, image, bar)
    return image


def colour_bar(axes, image, label):
    """A slim colour bar beside `axes`, as high as what they show."""
    made = axes.figure.colorbar(image, cax=axes.inset_axes((1.025, 0, 0.04, 1)))
    made.outline.set_linewidth(0.4)
    made.set_label(label)
    return made


def bare(axes, title=""):
    """No ticks, a hairline frame."""
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set(visible=True, linewidth=0.4, color="#999999")
    if title:
        axes.set_title(title)


def thumbnail(values, limit=1100):
    """`values` (row, column) averaged over whole blocks so that neither side exceeds `limit`,
    and the block size used.
    """
    from plenocli.forward.scene.sample import block_mean

    step = max(1, -(-max(values.shape) // limit))
    rows, cols = (n // step * step for n in values.shape)
    if step == 1 or not rows or not cols:
        return values, 1
    return block_mean(values[:rows, :cols], (step, step)), step


def nanometres(wavelength):
    """A wavelength in m as text, "550 nm"."""
    return f"{wavelength * 1e9:.4g} nm"


def swatch(rgb):
    """Display colour, a tuple for matplotlib, of linear sRGB (3,)."""
    from plenocli.forward.scene.colour import encode_srgb

    return tuple(float(v) for v in encode_srgb(np.asarray(rgb)))
