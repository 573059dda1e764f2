"""What every effect must do, one suite over all of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from monitor.core import Array
from monitor.model import (
    EFFECTS,
    FORMS,
    Effect,
    EffectError,
    LawKind,
    MatrixStructure,
    Model,
    Peak,
    ShearFrame,
    System,
    parse_effect,
    simulate,
)
from tests.contracts.effect_cases import (
    CASES,
    CONTEXT,
    RATE_HZ,
    STRUCTURE,
    condition_of,
    measured,
    misfit,
    parse,
    predicted,
    system_of,
)
from tests.model.laws import force

AT_REST = condition_of(system_of(Model(STRUCTURE)))
HZ = np.array([3.0, 17.0])
NAMES = [
    *(
        "stiffness_change",
        "added_mass",
        "temperature_stiffness",
        "cubic_stiffness",
        "gap_contact",
        "bilinear_stiffness",
    ),
    *("coulomb_friction", "quadratic_damping", "story_damper", "base_flexibility", "joint_flexibility"),
    *("gravity_softening", "attached_oscillator", "harmonic_excitation", "coloured_excitation", "base_excitation"),
    *("sensor_gain", "sensor_polarity", "channel_swap", "sensor_rotation", "time_offset", "clock_rate"),
    *("sensor_clipping", "sensor_noise"),
    "unmodelled_mode",
    "hysteretic_slip",
]
ROUGH = {  # the largest deviation in a band of 1 Hz that the linearization of each law leaves, over the measured power
    "cubic_stiffness": 2.0, "gap_contact": 1.0, "bilinear_stiffness": 0.7, "coulomb_friction": 0.3,
    "quadratic_damping": 0.3, "sensor_clipping": 8.0, "hysteretic_slip": 1.6,
}  # fmt: skip

every = pytest.mark.parametrize("text", CASES)


def every_start() -> list[Effect]:
    peak = Peak(9.0, np.array([0.5, -0.2, 0.1]))
    return [
        start
        for effect in EFFECTS.values()
        for place in effect.places_in(CONTEXT)
        for start in (*effect.starts(place, CONTEXT, AT_REST), effect.at_peak(place, peak, CONTEXT, AT_REST))
        if start is not None
    ]


def absent(effect: Effect) -> Effect | None:
    """The effect of no size, if a parameter can say so."""
    values = effect.values()
    gone = {p.name: p.absent for p in effect.parameters if p.absent is not None}
    if effect.name == "unmodelled_mode":
        return replace(effect, shape=(0.0,) * len(effect.shape))
    return type(effect)(effect.location, **{**values, **gone}) if gone else None


def test_the_catalogue_is_the_contracts() -> None:
    assert list(EFFECTS) == NAMES
    assert {text.partition(":")[0] for text in CASES} == set(FORMS)
    for name, effect in FORMS.items():
        assert effect.name == name and effect.__doc__ and effect.signature


@every
def test_what_is_not_known_of_a_law_s_form_leaves_its_size_known(text: str) -> None:
    effect = parse_effect(text)
    assert (effect.form_std <= 0.2 * np.abs(effect.coordinates)).all()


@every
def test_bounds_and_names_of_parameters_are_kept(text: str) -> None:
    effect = parse_effect(text)
    for p in effect.parameters:
        edges = [p.high, np.nan, np.inf, -np.inf, *([p.low - 1e-6] if p.closed else [p.low])]
        for value in edges:
            with pytest.raises(EffectError, match=p.name):
                FORMS[effect.name].create(effect.location, {**effect.values(), p.name: float(value)})
        if p is effect.parameters[-1] and effect.name == "unmodelled_mode":
            continue  # a shape of fewer channels, which `check` refuses
        with pytest.raises(EffectError, match=p.name):
            FORMS[effect.name].create(effect.location, {k: v for k, v in effect.values().items() if k != p.name})
    with pytest.raises(EffectError, match="exactly"):
        FORMS[effect.name].create(effect.location, {**effect.values(), "more": 1.0})
    for place in {"story 1", "floor 1", "channel a1", "channel a1,a2", "base", "frame"}:
        kind = {"story": "story", "floor": "floor"}.get(
            place.split()[0], "channels" if "," in place else place.split()[0]
        )
        if kind not in FORMS[effect.name].places:
            with pytest.raises(EffectError, match="no place"):
                FORMS[effect.name].create(place, effect.values())


@every
def test_coordinates_go_there_and_back_and_stay_within_bounds(text: str) -> None:
    effect = parse_effect(text)
    again = effect.at(effect.coordinates)
    assert type(again) is type(effect) and again.location == effect.location
    np.testing.assert_allclose(list(again.values().values()), list(effect.values().values()), rtol=1e-12)
    for far in (-1e9, 1e9):
        pushed = effect.at(np.full(len(effect.parameters), far))
        assert pushed == FORMS[effect.name].create(pushed.location, pushed.values())


def test_starts_are_valid_and_small() -> None:
    n, drawn = STRUCTURE.n_dofs, np.diag(STRUCTURE.stiffness_matrix())
    for start in every_start():
        told = f"{start.name} at {start.location}"
        assert start == EFFECTS[start.name].create(start.location, start.values()), told
        start.check(STRUCTURE, CONTEXT.channels)
        mass, stiffness = start.structural(STRUCTURE.mass_matrix(), STRUCTURE.stiffness_matrix(), STRUCTURE)
        system = start.extend(System(mass, Model(STRUCTURE).damping_matrix(), stiffness), CONTEXT, AT_REST)
        np.testing.assert_allclose(np.diag(system.stiffness)[:n], drawn, rtol=0.15, err_msg=told)
        assert np.linalg.eigvalsh(system.stiffness).min() > 0 and np.linalg.eigvalsh(system.mass).min() > 0, told


@pytest.mark.parametrize("share", [1.0, 3.0])
def test_a_clipped_channel_starts_at_a_limit_that_it_reaches(share: float) -> None:
    peaks = share * AT_REST.channel_m_s2
    for j, channel in enumerate(CONTEXT.channels):
        found = EFFECTS["sensor_clipping"].starts(
            f"channel {channel}", CONTEXT, replace(AT_REST, channel_peak_m_s2=peaks)
        )
        assert found and all(0.0 < start.values()["limit_m_s2"] <= peaks[j] for start in found)
        assert all(start == EFFECTS["sensor_clipping"].create(start.location, start.values()) for start in found)


def test_every_place_has_a_start() -> None:
    found = {(s.name, s.location) for s in every_start()}
    for name, effect in EFFECTS.items():
        assert {(name, place) for place in effect.places_in(CONTEXT)} <= found


@pytest.mark.parametrize(
    "none", [e for e in map(absent, map(parse_effect, CASES)) if e], ids=lambda e: f"{e.name}-{e.location}"
)
def test_of_no_size_it_changes_not_a_bit(none: Effect) -> None:
    mass, stiffness, damping = STRUCTURE.mass_matrix(), STRUCTURE.stiffness_matrix(), Model(STRUCTURE).damping_matrix()
    for new, old in zip(none.structural(mass, stiffness, STRUCTURE), (mass, stiffness), strict=True):
        np.testing.assert_array_equal(new, old)
    system = none.extend(System(mass, damping, stiffness), CONTEXT, AT_REST)
    for new, old in ((system.mass, mass), (system.damping, damping), (system.stiffness, stiffness)):
        np.testing.assert_array_equal(new, old)
    assert np.all(none.colour(HZ) == 1.0) and none.ground_share == 0.0 and none.clock_factor == 1.0
    assert np.all(none.noise_variance(CONTEXT, AT_REST) == 0.0) and all(line.force_n == 0.0 for line in none.lines())
    response = none.response(HZ, CONTEXT, AT_REST)
    if response is not None:
        np.testing.assert_array_equal(response, np.broadcast_to(np.eye(3), response.shape))
    rng = np.random.default_rng(0)
    samples = rng.standard_normal((50, 3))
    np.testing.assert_array_equal(none.drive(samples, RATE_HZ), samples)
    np.testing.assert_array_equal(none.measure(samples, RATE_HZ, CONTEXT, rng), samples)
    factor = none.stiffness_factor(samples[:, 0], RATE_HZ)
    assert factor is None or np.all(factor == 1.0)
    for law in none.laws(STRUCTURE):
        assert force(law, 0.003, 0.1) == 0.0 and force(law, -0.003, -0.1) == 0.0


@every
def test_each_size_alone_takes_its_laws_away(text: str) -> None:
    effect = parse_effect(text)
    for p in effect.parameters:
        if p.absent is not None and effect.laws(STRUCTURE):
            gone = replace(effect, **{p.name: p.absent})
            assert all(force(law, 0.003, 0.1) == 0.0 for law in gone.laws(STRUCTURE)), p.name


@every
def test_at_rest_its_laws_have_no_force_and_what_follows_the_velocity_brakes_alike_both_ways(text: str) -> None:
    for law in parse_effect(text).laws(STRUCTURE):
        assert force(law, 0.0, 0.0) == 0.0
        if law.kind in {LawKind.FRICTION, LawKind.QUADRATIC}:
            for speed in (1e-4, 0.1):
                forth, back = force(law, 0.003, speed), force(law, 0.003, -speed)
                assert forth > 0.0 and back == pytest.approx(-forth, rel=1e-9)


@every
def test_its_arguments_are_left_alone(text: str) -> None:
    effect, rng = parse_effect(text), np.random.default_rng(0)
    arrays: list[Array] = [STRUCTURE.mass_matrix(), STRUCTURE.stiffness_matrix(), rng.standard_normal((40, 3))]
    before = [a.copy() for a in arrays]
    effect.structural(arrays[0], arrays[1], STRUCTURE)
    effect.extend(System(arrays[0], arrays[1], arrays[1]), CONTEXT, AT_REST)
    effect.drive(arrays[2], RATE_HZ)
    effect.measure(arrays[2], RATE_HZ, CONTEXT, rng)
    effect.stiffness_factor(arrays[2][:, 0], RATE_HZ)
    for array, old in zip(arrays, before, strict=True):
        np.testing.assert_array_equal(array, old)


@every
def test_it_is_simulated_and_repeats_with_its_seed(text: str) -> None:
    excess = np.full(2048, 5.0)
    plain, first, again = (
        simulate(
            Model(STRUCTURE, e), duration_s=2.0, rate_hz=RATE_HZ, context=CONTEXT, seed=1, excess_degc=excess
        ).floors
        for e in ((), parse(text), parse(text))
    )
    np.testing.assert_array_equal(first, again)
    assert np.isfinite(first).all()
    assert np.abs(first - plain).max() > 1e-6 * np.abs(plain).max()


@every
def test_both_faces_say_the_same(text: str) -> None:
    """Measured cross-spectra of 300 s over the predicted ones, in bands of 1 Hz: each scatters by 6 %."""
    effect, warm = parse(text), 10.0
    spectra, rms = measured(effect, 300.0, 5, warm)
    left, without = (misfit(spectra, predicted(e, rms, warm)) for e in (effect, ()))
    rough = ROUGH.get(effect[0].name)
    assert np.abs(left).max() < (0.28 if rough is None else rough)
    if rough is None:
        assert np.abs(left.mean(axis=0)).max() < 0.05
    assert (np.abs(left) ** 2).sum() < 0.7 * (np.abs(without) ** 2).sum(), "the simulation shows nothing of the effect"


@pytest.mark.parametrize("name", ["joint_flexibility", "base_flexibility", "gravity_softening"])
def test_what_a_structure_lacks_is_said(name: str) -> None:
    bare = ShearFrame(STRUCTURE.masses_kg, STRUCTURE.stiffness_n_per_m, 0.01)
    effect = next(parse_effect(text) for text in CASES if text.startswith(name))
    if name == "gravity_softening":
        with pytest.raises(EffectError, match="story_heights_m"):
            effect.check(bare, CONTEXT.channels)
    else:
        effect.check(bare, CONTEXT.channels)


@pytest.mark.parametrize(
    "text",
    ["channel_swap:channel a2,a1", "channel_swap:channel a1,a1", "channel_swap:channel a1,b", "sensor_gain:channel x:gain=2",
     "story_damper:story 4:damping_n_s_per_m=1", "added_mass:floor 4:mass_kg=1"],
)  # fmt: skip
def test_places_that_the_structure_has_not_are_refused(text: str) -> None:
    with pytest.raises(EffectError):
        parse(text)


@pytest.mark.parametrize("text", [c for c in CASES if ":story" in c or ":floor" in c])
def test_a_structure_given_by_the_same_matrices_moves_alike(text: str) -> None:
    frame, effects = STRUCTURE, parse(text)
    given = MatrixStructure.create(
        frame.mass_matrix(), frame.stiffness_matrix(), frame.stiffness_derivatives(), frame.stiffness_n_per_m, 0.01
    )
    motions = [simulate(Model(s, effects), duration_s=1.0, rate_hz=RATE_HZ).floors for s in (frame, given)]
    np.testing.assert_allclose(motions[1], motions[0], atol=1e-8)
