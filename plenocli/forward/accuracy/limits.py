"""What limits a result that was made with a system matrix: the noise of the capture, or the
error of the model.
"""

import math


def what_limits(noise, matrix, capture=None, same=False):
    """Compare a capture's noise with what is wrong with the matrix that explained it, both
    relative to the capture.

    noise: sigma over root mean square;
    matrix, capture: accuracy records (dicts with "estimated" and "model_error", the error of the
        model itself, and "model") of the matrix and of a simulated capture, None for a real one;
    same: whether the capture was simulated with this very matrix.
    Returns {"noise", "model_error", "limited_by": "noise" or "model", "reason"} or None where the
    records do not say.
    """
    if not noise or not matrix or "estimated" not in matrix:
        return None
    if same:
        error, reason = (
            0.0,
            "the capture was simulated with this very matrix, so no model error shows",
        )
    elif capture and "estimated" in capture:
        models = (
            0.0
            if capture.get("model") == matrix.get("model")
            else max(matrix.get("model_error") or 0.0, capture.get("model_error") or 0.0)
        )
        error = math.hypot(matrix["estimated"], capture["estimated"], models)
        reason = (
            f"capture simulated by the {capture.get('model')} model, explained by the "
            f"{matrix.get('model')} one"
        )
    else:
        error, reason = (
            math.hypot(matrix["estimated"], matrix.get("model_error") or 0.0),
            "a real capture, against the finest model",
        )
    return {
        "noise": float(noise),
        "model_error": float(error),
        "limited_by": "noise" if noise >= error else "model",
        "reason": reason,
    }
