"""Reads a site's healthy baseline, of the kind that its structure file asks for."""

from __future__ import annotations

from pathlib import Path

from monitor.config import Configuration
from monitor.damage import AnyBaseline, Origin, load_baseline, load_modal_baseline


def load_healthy(path: Path, config: Configuration) -> AnyBaseline:
    """Read the baseline of a site, with the reasons in `doubts` why it may not be this structure's.

    Raises MissingInputError if the file cannot be read, BadInputError if it is no baseline or damaged, and
    BadConfigurationError if the baseline is another structure's, or of another kind.
    """
    if config.has_model:
        return load_baseline(path, config.instrumented(), config.updating)
    return load_modal_baseline(path, config.channels, modal_origin(config))


def modal_origin(config: Configuration) -> Origin:
    """Describe the structure and the samples of a structure file without a model."""
    samples = config.processing
    return Origin.of_modes(config.structure.name, samples.rate_hz, samples.cutoff_hz)
