"""What limits a result that was made with a system matrix: the noise of the capture, or the
error of the model.
"""

import math
from dataclasses import dataclass

from plenocli.base.text import Record
from plenocli.forward.propagation.accuracy_record import AccuracyRecord


@dataclass(frozen=True, kw_only=True)
class Limits(Record):
    """Noise against model error, both relative to the capture's root mean square.

    limited_by: "noise" or "model", whichever is larger;
    reason: what the model error was taken against.
    """

    noise: float
    model_error: float
    limited_by: str
    reason: str


def what_limits(
    noise: float | None,
    matrix: AccuracyRecord | None,
    capture: AccuracyRecord | None = None,
    same: bool = False,
) -> Limits | None:
    """Compare a capture's noise with what is wrong with the matrix that explained it.

    noise: sigma over root mean square of the capture;
    matrix: how accurate the matrix is;
    capture: how accurately the capture was simulated, None for a real one;
    same: whether the capture was simulated with this very matrix.

    Returns None where the records do not say.
    """
    if not noise or matrix is None or matrix.estimated is None:
        return None
    if same:
        error = 0.0
        reason = "the capture was simulated with this very matrix, so no model error shows"
    elif capture is not None and capture.estimated is not None:
        models = (
            0.0
            if capture.model == matrix.model
            else max(matrix.model_error or 0.0, capture.model_error or 0.0)
        )
        field = (matrix.field_error or 0.0) - (capture.field_error or 0.0)
        error = math.hypot(matrix.estimated, capture.estimated, models, field)
        reason = (
            f"capture simulated by the {capture.model} model, explained by the {matrix.model} one"
        )
    else:
        error = math.hypot(matrix.estimated, matrix.model_error or 0.0, matrix.field_error or 0.0)
        reason = "a real capture, against the finest model"
    return Limits(
        noise=float(noise),
        model_error=float(error),
        limited_by="noise" if noise >= error else "model",
        reason=reason,
    )
