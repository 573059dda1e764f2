"""What a file keeps."""

from __future__ import annotations

import json

from monitor.config import Configuration
from monitor.model import StructuralPrior, prior_file


def through_its_file(known: StructuralPrior, config: Configuration) -> StructuralPrior:
    """Write a reference as a baseline holds it, and read it back."""
    plain = json.loads(json.dumps(prior_file.prior_content(known), allow_nan=False))
    read = prior_file.read_prior(plain, config.model(), config.channels)
    assert read is not None
    return read
