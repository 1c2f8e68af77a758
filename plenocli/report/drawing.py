"""One look for all pictures: figures made without pyplot, drawn by Agg, handed
back as PNG bytes.
"""

import io
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from plenocli.base.errors import UsageError
from plenocli.base.text import how_to_install, printable_lines
from plenocli.base.tiling import Plane

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colorbar import Colorbar
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage
    from PIL import Image, ImageFont

Figures = list[tuple[bytes, str]]
"""Pictures (PNG) with their captions."""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A5C00", "#555555")
"""Okabe and Ito's palette, told apart with any colour vision, in the order of use."""
TRUTH = "#1a1a1a"
LIGHT_MAP = "inferno"  # amounts of light, dark is none
LEVEL_MAP = "viridis"  # other positive quantities
SIGN_MAP = "RdBu_r"  # differences, white is none
GRID_LINE = "#56B4E9"
DPI = 130
THUMB = 600
"""Points of a side beyond which a picture is drawn from averages over blocks: panels have hardly
more pixels, and matplotlib takes 60 bytes a point.
"""
_SAMPLE = 1 << 20
"""Values of a picture that its statistics need at most."""

_STYLE: dict[Any, Any] = {
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

    def __init__(self, figure: "Figure") -> None:
        """Begin with an empty `figure`."""
        self.figure, self.png = figure, b""


@contextmanager
def drawing(
    width: float, height: float, layout: Literal["constrained"] | None = "constrained"
) -> Iterator[Drawing]:
    """A Drawing in the house style; rendered when the block ends.

    width, height: inches.
    layout: matplotlib's layout engine; None for figures of many panels, which it would take
        seconds to arrange.

    Raises UsageError where matplotlib is not installed.
    """
    try:
        import matplotlib.text
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
        powers = [
            label
            for axes in made.figure.axes
            for axis in (axes.xaxis, axes.yaxis)
            if axis.get_scale() == "log"
            for label in axis.get_ticklabels(which="both")
        ]
        for text in made.figure.findobj(matplotlib.text.Text):
            if text not in powers:
                text.set_text(printable_lines(text.get_text()))
                text.set_parse_math(False)  # a $ in the name of a file is no formula
        buffer = io.BytesIO()
        made.figure.savefig(buffer, format="png", metadata={"Software": None})
        made.png = buffer.getvalue()


QUALITY = 80
"""Of pictures on pages; letters and lines stay sharp on a screen."""


def compact(png: bytes) -> bytes:
    """A PNG as WebP for a page: without loss where that is smaller, as it is for plain drawings."""
    from PIL import Image

    image, made = Image.open(io.BytesIO(png)).convert("RGB"), []
    for options in ({"quality": QUALITY}, {"lossless": True, "method": 2}):
        buffer = io.BytesIO()
        image.save(buffer, "webp", **options)
        made.append(buffer.getvalue())
    return min(made, key=len)


def show_picture(axes: "Axes", values: ArrayLike, title: str = "", **options: Any) -> None:
    """A picture without ticks, encoded for the screen as sRGB is.

    axes: that show it.
    values: (row, column) linear light, white at 1, or (row, column, 3).
    title: above it.
    options: of imshow.
    """
    from plenocli.forward.scene.colour import encode_srgb

    values = np.asarray(values, dtype=np.float64)
    if values.ndim == 2:
        options = {"cmap": "gray", "vmin": 0, "vmax": 1} | options
    axes.imshow(encode_srgb(np.nan_to_num(values)), **options)
    bare(axes, title)


def show_map(
    axes: "Axes", values: np.ndarray, title: str = "", bar: str = "", **options: Any
) -> "AxesImage":
    """A map (row, column) with a colour bar labelled `bar` (quantity and unit); `options` of
    imshow.
    """
    image = axes.imshow(values, **options)
    bare(axes, title)
    colour_bar(axes, image, bar)
    return image


def colour_bar(axes: "Axes", image: Any, label: str) -> "Colorbar":
    """A slim colour bar beside `axes`, as high as what they show."""
    made = axes.figure.colorbar(image, cax=axes.inset_axes((1.025, 0, 0.04, 1)))
    made.outline.set_linewidth(0.4)
    made.set_label(label)
    return made


def bare(axes: "Axes", title: str = "") -> None:
    """No ticks, a hairline frame."""
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set(visible=True, linewidth=0.4, color="#999999")
    if title:
        axes.set_title(title)


def thumbnail(values: "ArrayLike | Plane", limit: int = THUMB) -> tuple[np.ndarray, int]:
    """A picture averaged over whole blocks.

    values: (row, column).
    limit: of either side.

    Returns (picture, side of a block).
    """
    made = overview(values, limit)
    return made.small, made.step


@dataclass(frozen=True, kw_only=True)
class Overview:
    """A picture that may not fit the memory, seen once from the first row to the last.

    small: (..., row, column) averaged over blocks of `step` x `step` points.
    sample: its values for statistics, (n,), all of them or those of an even grid.
    """

    small: np.ndarray
    step: int
    sample: np.ndarray


def overview(values: "ArrayLike | Plane", limit: int = THUMB) -> Overview:
    """The Overview of a picture (..., row, column); `limit`: of either side of what is small."""
    from plenocli.forward.scene.sample import block_mean

    plane = Plane.of(values)
    step = max(1, -(-max(plane.shape[-2:]) // limit))
    rows, columns = (n // step * step for n in plane.shape[-2:])
    step = step if rows and columns else 1
    every = math.ceil((math.prod(plane.shape) / _SAMPLE) ** 0.5)
    lead = plane.shape[:-2]
    small = np.empty((*lead, rows // step, columns // step) if step > 1 else plane.shape)
    sample = np.empty((*lead, *(-(-n // every) for n in plane.shape[-2:])))
    for part in plane.in_bands(math.lcm(step, every)):
        band = plane.window(part)
        of_sample = band[..., ::every, ::every]
        first = part.start // every
        sample[..., first : first + of_sample.shape[-2], :] = of_sample
        whole = band[..., : max(rows - part.start, 0), :columns]
        first, count = part.start // step, whole.shape[-2] // step
        if step == 1:
            small[..., part, :] = band
        elif whole.size:
            small[..., first : first + count, :] = block_mean(whole, (step, step))
    return Overview(small=small, step=step, sample=sample.reshape(-1))


def nanometres(wavelength: float) -> str:
    """A wavelength in m as text, "550 nm"."""
    return f"{wavelength * 1e9:.4g} nm"


def swatch(rgb: ArrayLike) -> tuple[float, ...]:
    """Display colour, a tuple for matplotlib, of linear sRGB (3,)."""
    from plenocli.forward.scene.colour import encode_srgb

    return tuple(float(v) for v in encode_srgb(np.asarray(rgb)))


_LETTER, _LINE = 16, 24
"""Height of a letter and of a line of a caption on a sheet of pictures, pixels."""


TALLEST = 8000
"""Of a sheet, px: from there on its pictures stand side by side at half their size."""


def stacked(figures: Figures) -> bytes:
    """One PNG of several, below each other on white, each under its caption; many of them in
    columns at half their size, so that the sheet stays about as wide as it is high.
    """
    from matplotlib.font_manager import findfont
    from PIL import Image, ImageFont

    font = ImageFont.truetype(findfont("DejaVu Sans"), _LETTER)
    images = [Image.open(io.BytesIO(png)).convert("RGB") for png, _ in figures]
    count = 1
    if sum(image.height for image in images) > TALLEST:
        images = [image.reduce(2) for image in images]
        area = sum(image.height for image in images) * max(image.width for image in images)
        count = max(2, round(area**0.5 / max(image.width for image in images)))
    width = max(image.width for image in images)
    cells = [
        _captioned(image, caption, width, font)
        for image, (_, caption) in zip(images, figures, strict=True)
    ]
    lines = [cells[start : start + count] for start in range(0, len(cells), count)]
    heights = [max(cell.height for cell in line) for line in lines]
    sheet = Image.new(
        "RGB",
        (count * width + (count - 1) * _LINE, sum(heights) + _LINE * (len(lines) - 1)),
        "white",
    )
    for number, line in enumerate(lines):
        top = sum(heights[:number]) + _LINE * number
        for place, cell in enumerate(line):
            sheet.paste(cell, (place * (width + _LINE), top))
    buffer = io.BytesIO()
    sheet.save(buffer, "png")
    return buffer.getvalue()


def _captioned(
    image: "Image.Image", caption: str, width: int, font: "ImageFont.FreeTypeFont"
) -> "Image.Image":
    """A picture on white, `width` px wide, under its caption."""
    import textwrap

    from PIL import Image, ImageDraw

    lines = textwrap.wrap(caption, max(20, int(width / (0.56 * _LETTER))))
    top = len(lines) * _LINE + _LINE // 2
    cell = Image.new("RGB", (width, top + image.height), "white")
    pen = ImageDraw.Draw(cell)
    for number, line in enumerate(lines):
        pen.text((10, 6 + number * _LINE), line, fill="#5b6670", font=font)
    cell.paste(image, ((width - image.width) // 2, top))
    return cell
