"""When the discrepancy engine names a cause."""

from __future__ import annotations

from pydantic import Field

from monitor.core import Settings


class DiagnosisSettings(Settings):
    """``[diagnosis]``: when a cause is named."""

    margin: float = Field(default=7.0, gt=0)
    """Evidence above the model without the cause, nats, over all candidates (calibrated on clean records)."""
    rival: float = Field(default=4.6, gt=0)
    """A rival less than this many nats behind cannot be told from the winner (odds of 100 to 1)."""
    worth: float = Field(default=2.0, ge=0)
    """Gain that the score test must promise for a candidate to be fitted, nats."""
    ranked: int = Field(default=20, ge=1)
    """How many of those are fitted roughly."""
    tried: int = Field(default=6, ge=1)
    """How many of those are fitted to the end."""
    favourites: int = Field(default=3, ge=0)
    """How many of the score test's best are fitted to the end in any case."""
    max_causes: int = Field(default=3, ge=1)
    """How many may act together."""
    linearization: float = Field(default=0.05, ge=0, lt=1)
    """Share of the gain by which a linearized law may misjudge itself: rivals within it are simulated."""
    aftermath: float = Field(default=0.005, ge=0, lt=1)
    """Share of a nonlinear cause's gain that its simulation may still miss: less than that is no further cause."""
    share: float = Field(default=0.05, ge=0, lt=1)
    """Share of the misfit, in nats, that a cause must explain where no ground was measured: less may be made up by the rest."""
    remainder: float = Field(default=0.03, ge=0, lt=1)
    """Share of the squared misfit that a nonlinear cause may leave."""
    misfit: float = Field(default=6.0, gt=0)
    """Standard deviations from which what is left over in a band is a misfit."""
