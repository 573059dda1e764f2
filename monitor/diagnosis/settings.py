"""Settings of the diagnosis: the thresholds from which a cause is named."""

from __future__ import annotations

from pydantic import Field

from monitor.core import Settings


class DiagnosisSettings(Settings):
    """``[diagnosis]``: when a cause is named."""

    margin: float = Field(default=7.0, gt=0)
    """Evidence above the model without the cause, nats, over all candidates (calibrated on clean records)."""
    rival: float = Field(default=4.6, gt=0)
    """Log odds below which a rival cannot be distinguished from the best candidate, nats (odds of 100 to 1)."""
    worth: float = Field(default=2.0, ge=0)
    """Gain that the score test must promise for a candidate to be fitted, nats."""
    ranked: int = Field(default=20, ge=1)
    """Number of these candidates that are fitted roughly."""
    tried: int = Field(default=6, ge=1)
    """Number of these that are fitted fully."""
    favourites: int = Field(default=3, ge=0)
    """Number of the best candidates by the score test that are fitted fully in any case."""
    max_causes: int = Field(default=3, ge=1)
    """Largest number of causes that may act together, without modes that the model lacks, and beside a measured input without
    sensors' faults."""
    linearization: float = Field(default=0.05, ge=0, lt=1)
    """Relative error that the gain of a linearized law may have: rivals within it are simulated."""
    aftermath: float = Field(default=0.005, ge=0, lt=1)
    """Share of a nonlinear cause's gain that its simulation may still miss: a smaller gain is no evidence of a further cause."""
    share: float = Field(default=0.05, ge=0, lt=1)
    """Share of the misfit, in nats, that a cause must explain where no ground was measured: other parameters may imitate less."""
    remainder: float = Field(default=0.03, ge=0, lt=1)
    """Share of the squared misfit that a nonlinear cause may leave."""
    false_rate: float = Field(default=0.01, gt=0, lt=1)
    """Chance, for all causes that a diagnosis seeks together, that one is stated though its size is none."""
    misfit: float = Field(default=6.0, gt=0)
    """Standard deviations from which the remaining difference in a band is a misfit."""
