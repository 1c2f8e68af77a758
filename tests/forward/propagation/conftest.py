"""What tests of one model share."""

import pytest

from plenocli.forward.accuracy import dial
from plenocli.forward.propagation.models import MODELS


@pytest.fixture
def without_openings(monkeypatch):
    """The dial without the sum over openings, which costs less for lenslets of few cells: small
    cameras try the other exact models.
    """
    others = tuple(model for model in MODELS if model.name != "exact, openings")
    monkeypatch.setattr(dial, "MODELS", others)
