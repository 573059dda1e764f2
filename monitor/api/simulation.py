"""Simulated recordings with known truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from monitor.api.recording import Recording
from monitor.api.structures import Structure
from monitor.core import BadConfigurationError, BadInputError, single_blas_thread
from monitor.model import Effect, ExcitationKind, parse_effect, simulate as simulate_motion, story_damage
from monitor.runs import require_stable


@single_blas_thread()
def simulate(
    structure: Structure,
    *,
    duration_s: float,
    rate_hz: float,
    excitation: ExcitationKind = "ambient",
    noise: float = 0.0,
    damage: Mapping[int, float] | None = None,
    effects: Sequence[str | Effect] = (),
    level_spread: float = 0.0,
    seed: int = 0,
) -> Recording:
    """Simulate a recording of a structure; the same seed gives the same recording.

    Parameters
    ----------
    excitation : {"ambient", "impulse", "ground", "force", "sweep"}
        White forces on every floor; a hammer blow every 10 s; a measured ground motion; measured forces beside the ambient ones;
        a shaker that sweeps once over the modes.
    noise
        Sensor noise, as a fraction of the mean RMS of the channels.
    damage
        Relative loss of stiffness by story (from 1): ``{2: 0.12}``.
    effects
        Effects as of the command ``simulate``, ``"cubic_stiffness:story 1:k3_n_per_m3=3e8"``, or objects.
    level_spread
        Relative spread of the slowly varying level of the excitation; 0.35 for wind.

    Raises
    ------
    UserError
        An effect is not known or does not fit the structure, or the structure would not stand.

    Examples
    --------
    >>> import shm_monitor as shm
    >>> frame = shm.structure(masses_kg=[1000.0, 1000.0], stiffness_n_per_m=[2e6, 2e6])
    >>> shm.simulate(frame, duration_s=10, rate_hz=100, damage={2: 0.1}).samples.shape
    (1000, 2)
    """
    config, site = structure.config, structure.instrumented
    if not (duration_s > 0 and rate_hz > 0 and round(duration_s * rate_hz) > 0):
        raise BadInputError(f"simulate: duration_s = {duration_s}, rate_hz = {rate_hz}: must give one sample or more")
    try:
        planted = [story_damage(story, loss) for story, loss in (damage or {}).items()]
        planted += [parse_effect(effect) if isinstance(effect, str) else effect for effect in effects]
        truth = require_stable(replace(site.model, effects=(*site.model.effects, *planted)), structure.channels)
        motion = simulate_motion(
            truth,
            duration_s=duration_s,
            rate_hz=rate_hz,
            excitation=excitation,
            noise=noise,
            level_spread=level_spread,
            seed=seed,
            context=site.context(rate_hz),
            forced=[table.floor for table in config.inputs],
        )
    except ValueError as error:  # includes EffectError
        raise BadConfigurationError(f"simulate: {error}") from error
    return Recording(motion.floors, rate_hz, structure.channels, 0, motion.ground, motion.force)
